"""Image files of any kind that OpenCV reads, as the RGB images the codecs take."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError
from semcast.common.tiff_alpha import is_laid_on_black

#: Resampling and sharpening leave pictures of 0..1 or 0..255 with values above, but hardly by this factor.
_OVERSHOOT = 2.0
#: Bits of a 16-bit image that cameras use, always the lower ones.
_BIT_DEPTHS = (8, 10, 12, 14, 16)
#: Images, spread over a recording, that tell its bit depth: a dark beginning alone would mislead.
_MAX_DEPTH_IMAGES = 9


def read_image(path: Path, bit_depth: Callable[[], int | None] | None = None) -> NDArray[np.uint8]:
    """Read an image file as ``(H, W, 3)`` uint8 RGB.

    Grey is repeated, 16-bit is cut to 8, transparency is laid on white. Orientation notes of cameras are
    not applied: a calibration belongs to the pixels as stored.

    Args:
        path: The file.
        bit_depth: Tells how many bits of a 16-bit file are in use; asked for such files alone. None, or
            an answer of None, goes by the brightest value of this one, so that images read one by one may
            differ in brightness.

    Raises:
        SourceError: The file is missing or damaged.
    """
    raw, is_on_black = _read_raw(path)
    if raw.dtype == np.uint16:
        bits = (bit_depth() if bit_depth is not None else None) or _bits_for(int(raw.max()))
        raw = (np.minimum(raw, 2**bits - 1) >> (bits - 8)).astype(np.uint8)
    try:
        return as_rgb(raw, is_on_black=is_on_black)
    except SourceError as err:
        raise SourceError(f"{path}: {err}") from err


def bit_depth_of(paths: tuple[Path, ...]) -> int | None:
    """Tell how many bits of 16-bit images are in use: 8, 10, 12, 14 or 16; None where none is seen.

    Machine vision and thermal cameras store 10 to 14 bits as the lower ones of 16.

    Args:
        paths: Images of one camera; a few are looked at.
    """
    brightest: int | None = None
    spread = np.linspace(0, len(paths) - 1, min(len(paths), _MAX_DEPTH_IMAGES)).astype(int)
    for path in (paths[k] for k in spread):
        try:
            raw, _ = _read_raw(path)
        except SourceError:
            continue
        if raw.dtype == np.uint16:
            brightest = max(brightest or 0, int(raw.max()))
    return None if brightest is None else _bits_for(brightest)


def _bits_for(brightest: int) -> int:
    return next(bits for bits in _BIT_DEPTHS if brightest < 2**bits)


def _read_raw(path: Path) -> tuple[NDArray, bool]:
    """Read what OpenCV makes of a file, and whether its colours are multiplied by alpha."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except (OSError, ValueError) as err:  # a path with a NUL in it is a ValueError
        raise SourceError(f"{path} can't be read: {getattr(err, 'strerror', None) or err}") from err
    raw = decoded(data)
    if raw is None:
        raise SourceError(f"{path} is not a readable image (damaged, or of an unknown format)")
    is_on_black = raw.ndim == 3 and raw.shape[2] == 4 and is_laid_on_black(data.tobytes(), 8 * raw.itemsize)
    return raw, is_on_black


def decoded(data: NDArray[np.uint8]) -> NDArray | None:
    """Return the values in the bytes of an image file, as they are stored; None where it is none."""
    if not data.size:
        return None
    try:
        raw = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # sides beyond its limits, which a damaged header may state
        return None
    return None if raw is None else np.asarray(raw)


def as_rgb(raw: NDArray, *, is_on_black: bool = False) -> NDArray[np.uint8]:
    """Turn what OpenCV reads (grey, BGR or BGRA, of any number type) into ``(H, W, 3)`` uint8 RGB.

    Transparency is laid on white.

    Args:
        raw: The image.
        is_on_black: Colours are multiplied by alpha.

    Raises:
        SourceError: The values are neither those of 0..1 nor of 0..255, nor 16-bit, or there are two a pixel.
    """
    if raw.ndim == 3 and raw.shape[2] not in (1, 3, 4):
        raise SourceError(f"images must have 1, 3 or 4 values a pixel, got {raw.shape[2]}")
    raw = _as_bytes(raw)
    if raw.ndim == 2 or raw.shape[2] == 1:
        return np.asarray(cv2.cvtColor(raw, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    if raw.shape[2] == 4:
        alpha = raw[:, :, 3:].astype(np.uint16)
        colours = raw[:, :, 2::-1].astype(np.uint16)
        on_black = colours if is_on_black else (colours * alpha + 127) // 255
        return np.asarray(np.minimum(on_black + (255 - alpha), 255), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _as_bytes(raw: NDArray) -> NDArray[np.uint8]:
    """Bring values to 0..255; where white is, the type tells for 8 and 16 bit, else the values themselves."""
    if raw.dtype == np.uint8:
        return raw
    if raw.dtype == np.uint16:
        return (raw >> 8).astype(np.uint8)
    values = np.asarray(raw, dtype=np.float64)
    brightest = float(values.max(where=np.isfinite(values), initial=0.0))
    if brightest > 255.0 * _OVERSHOOT:
        raise SourceError(f"values must be in 0..1 or 0..255, got up to {brightest:g}")
    scale = 255.0 if raw.dtype.kind == "f" and brightest <= _OVERSHOOT else 1.0
    scaled = np.nan_to_num(values * scale, nan=0.0, posinf=255.0, neginf=0.0)
    return np.rint(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)
