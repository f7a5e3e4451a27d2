"""Image compression to a byte budget by OpenCV's JPEG, WebP and AVIF."""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.image import psnr_db, resized, scaled_wh
from semcast.common.image_header import states_at_most

ImageFormat = Literal["jpeg", "webp", "avif"]
#: Speeds of libaom, 0 to 10: in real time, and where 2.8 times that may be taken for a better image.
AVIF_SPEED, AVIF_SLOW_SPEED = 8, 6
#: Below this quality a smaller image at higher quality may look better, so both are tried.
_POOR_QUALITY = 40
_SCALES = (1.0, 0.75, 0.5, 0.35, 0.25, 0.125)
#: Range of the quality setting: AVIF at 0 is still an image, WebP above 100 would be lossless.
_MAX_QUALITY = 100


def _parameters(image_format: ImageFormat, quality: int, avif_speed: int) -> list[int]:
    if image_format == "jpeg":
        return [
            cv2.IMWRITE_JPEG_QUALITY,
            quality,
            cv2.IMWRITE_JPEG_PROGRESSIVE,
            1,
            cv2.IMWRITE_JPEG_OPTIMIZE,
            1,
        ]
    if image_format == "webp":
        return [cv2.IMWRITE_WEBP_QUALITY, quality]
    return [cv2.IMWRITE_AVIF_QUALITY, quality, cv2.IMWRITE_AVIF_SPEED, avif_speed]


def supported(image_format: ImageFormat) -> bool:
    """Return whether this OpenCV can write and read the format."""
    extension = f".{image_format}"
    return bool(cv2.haveImageWriter("x" + extension))


def compress(
    image_bgr: NDArray[np.uint8], image_format: ImageFormat, quality: int, avif_speed: int = AVIF_SPEED
) -> bytes:
    """Return the file of an image; ``quality`` in [1, 100], ``avif_speed`` in [0, 10] for AVIF alone."""
    done, data = cv2.imencode(f".{image_format}", image_bgr, _parameters(image_format, quality, avif_speed))
    if not done:
        raise ValueError(f"image of shape {image_bgr.shape} can't be written as {image_format}")
    return bytes(data.tobytes())


def decompress(data: bytes, shape_hw: tuple[int, int]) -> NDArray[np.uint8] | None:
    """Return the ``(H, W, 3)`` RGB image of a file, scaled up to ``shape_hw``.

    None when it is no image or states that it is larger.
    """
    if not states_at_most(data, shape_hw):
        return None
    image_bgr = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image_bgr is None:
        return None
    height, width = shape_hw
    if image_bgr.shape[:2] != shape_hw:
        image_bgr = cv2.resize(image_bgr, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _best_quality(
    image_bgr: NDArray[np.uint8], image_format: ImageFormat, budget_bytes: int, hint: int, avif_speed: int
) -> tuple[int, bytes] | None:
    """Return the highest quality whose file fits, and the file; None when not even quality 1 does.

    File size is taken to grow with quality, so the start of the search decides its length, not its result.
    """
    low, high = 0, _MAX_QUALITY + 1
    best: tuple[int, bytes] | None = None
    probe, step = min(max(hint, 1), _MAX_QUALITY), 2
    while high - low > 1:
        data = compress(image_bgr, image_format, probe, avif_speed)
        if len(data) <= budget_bytes:
            low, best = probe, (probe, data)
            probe = min(probe + step, _MAX_QUALITY) if high > _MAX_QUALITY else (low + high) // 2
        else:
            high = probe
            probe = max(probe - step, 1) if low == 0 else (low + high) // 2
        step *= 2
    return best


def compress_to_fit(
    image: NDArray[np.uint8],
    image_format: ImageFormat,
    budget_bytes: int,
    hint: int = 30,
    avif_speed: int = AVIF_SPEED,
) -> tuple[int, bytes] | None:
    """Compress an image as well as a byte budget allows.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        image_format: How.
        budget_bytes: The longest file allowed.
        hint: Where to start looking, for instance the quality of the frame before.
        avif_speed: See ``compress``.

    Returns:
        The quality used and the file: of the image itself at the highest quality that fits, or, where that
        quality is poor, of the image at a fraction of its size if that comes closer to the original. None
        when nothing fits.
    """
    image_bgr = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), dtype=np.uint8)
    shape_hw = (image.shape[0], image.shape[1])
    best: tuple[float, int, bytes] | None = None
    for scale in _SCALES:
        smaller = image_bgr
        if scale < 1.0:
            smaller = resized(image_bgr, scaled_wh(shape_hw[1], shape_hw[0], scale))
        found = _best_quality(smaller, image_format, budget_bytes, hint, avif_speed)
        if found is not None:
            quality, data = found
            if scale == 1.0 and quality >= _POOR_QUALITY:
                return quality, data
            decoded = decompress(data, shape_hw)
            score = psnr_db(decoded, image) if decoded is not None else 0.0
            if best is not None and score < best[0]:
                break
            best = (score, quality, data)
    return None if best is None else (best[1], best[2])
