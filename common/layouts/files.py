"""What a recorded sequence consists of, and what its layouts share: lists, times, a calibration beside."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.camera_file import read_intrinsics
from semcast.common.errors import SourceError
from semcast.common.image_order import in_order
from semcast.common.text_rows import TextRow, text_rows
from semcast.common.times import MAX_TIME_S, not_seconds, seconds_to_ns
from semcast.common.trajectory import Trajectory, read_tum, seconds_of

Row = TypeVar("Row")

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")
_ENDINGS = "|".join(suffix[1:] for suffix in IMAGE_SUFFIXES)
#: What follows the time in a line of a list of images, as far as the first end of an image's name.
_IMAGE_NAME = re.compile(rf"[^\s,]+[\s,]+(.+?\.({_ENDINGS}))(?=[\s,]|$)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(e[+-]?\d+)?", re.IGNORECASE)
_CALIBRATION_NAMES = ("intrinsics.json", "intrinsics.yaml", "camera.yaml", "calibration.yaml", "sensor.yaml")
_TIMES_NAME = "times.txt"
_TRUTH_NAME = "groundtruth.txt"
#: Files of semcast's own layout, beside ``images/``.
NATIVE_NAMES = (*_CALIBRATION_NAMES, _TIMES_NAME, _TRUTH_NAME)


@dataclass(frozen=True)
class SequenceFiles:
    """A recording on disk.

    Attributes:
        name: Folder name, for people.
        image_paths: One file per frame, in order of time.
        times_ns: ``(N,)`` int64, strictly increasing.
        camera: Returns the intrinsics, distortion included, of images of a given width and height, or None
            where the layout says nothing.
        groundtruth: Poses of this camera at their own times, or None. In metres but for a COLMAP model and a
            ``transforms.json``, which don't say their unit.
    """

    name: str
    image_paths: tuple[Path, ...]
    times_ns: NDArray[np.int64]
    camera: Callable[[int, int], Intrinsics | None]
    groundtruth: Trajectory | None


def check_times(path: Path, num_images: int, times_ns: NDArray[np.int64]) -> None:
    """Check that times ``(N,)`` are one for each image, and increase.

    Raises:
        SourceError: They are not, or do not.
    """
    if num_images != len(times_ns):
        raise SourceError(
            f"{path} must have one time per image, got {len(times_ns)} times and {num_images} images"
        )
    falls = np.flatnonzero(np.diff(times_ns) <= 0)
    if len(falls):
        k = int(falls[0])
        before_ns, after_ns = times_ns[k : k + 2].tolist()
        raise SourceError(
            f"times of {path} must strictly increase, image {k + 2} has {_short_s(after_ns)} s "
            f"after {_short_s(before_ns)} s"
        )


def _short_s(time_ns: int) -> str:
    return seconds_of(time_ns).rstrip("0").rstrip(".")


def images_in(folder: Path) -> tuple[Path, ...]:
    """Return the image files of a folder, ``in_order`` of their names; nothing is read from a pipe.

    Raises:
        SourceError: The folder can't be read.
    """
    try:
        found = [
            p
            for p in folder.iterdir()
            if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".") and not p.is_fifo()
        ]
    except OSError as err:
        raise SourceError(f"{folder} can't be read: {err}") from err
    return in_order(found)


def nominal_times_ns(count: int, rate_hz: float) -> NDArray[np.int64]:
    """Return ``(count,)`` int64 times of images at a steady rate, from zero on."""
    return np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def rows_of(path: Path, at_least: int, read: Callable[[TextRow], Row]) -> list[Row]:
    """Return what ``read`` makes of each line that is no comment, nor a first one that names the columns.

    Raises:
        SourceError: The file can't be read, or ``read`` raises ``ValueError`` for a line.
    """
    rows: list[Row] = []
    for k, row in enumerate(text_rows(path)):
        if k == 0 and row.fields[0].lower().startswith("time"):
            continue
        if len(row.fields) < at_least:
            raise SourceError(f"{path}:{row.number} must have {at_least} fields, got {row.line!r}")
        try:
            rows.append(read(row))
        except ValueError as err:
            raise SourceError(f"{path}:{row.number}: {err}") from err
    return rows


def image_name(row: TextRow) -> str:
    """Return the second field; blanks and commas may be part of it."""
    found = _IMAGE_NAME.match(row.line.split("#", 1)[0].strip())
    return found[1] if found else row.fields[1]


def finite_numbers(numbers: list[str], count: int) -> NDArray[np.float64]:
    """Return numbers that a pose can have.

    Raises:
        ValueError: One is none or is not finite, or they are not ``count``.
    """
    try:
        values = np.array([float(number) for number in numbers])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"must be {count} finite numbers, got {' '.join(numbers)}")
    return values


def _read_times_ns(path: Path) -> NDArray[np.int64]:
    return np.array(rows_of(path, 1, _time_ns), dtype=np.int64)


def _time_ns(row: TextRow) -> int:
    """Return the time of a line that holds nothing else; a decimal comma would cut it to whole seconds.

    Raises:
        ValueError: It is no number of seconds.
    """
    if _DECIMAL_COMMA.fullmatch(text := row.line.split("#", 1)[0].strip()):
        raise ValueError(f"time must have a decimal point, got {text!r}")
    return seconds_to_ns(row.fields[0])


def calibration_beside(folder: Path) -> Callable[[int, int], Intrinsics | None]:
    """Return what gives the camera of the calibration file in a folder: the first of those it may have."""
    found = [folder / name for name in _CALIBRATION_NAMES if (folder / name).is_file()]
    return lambda width, height: read_intrinsics(found[0]) if found else None


def truth_beside(folder: Path) -> Trajectory | None:
    """Return the ``groundtruth.txt`` of a folder, None without one.

    Raises:
        SourceError: It is damaged, or its times are no seconds.
    """
    path = folder / _TRUTH_NAME
    truth = read_tum(path) if path.is_file() else None
    if truth is not None and len(truth) and np.abs(truth.t_s).max() > MAX_TIME_S:
        latest = float(np.abs(truth.t_s).max())
        raise SourceError(f"{path}: {not_seconds(f'{latest:.0f}', latest)}")
    return truth


def times_beside(folder: Path, num_images: int, rate_hz: float) -> NDArray[np.int64]:
    """Return the ``(N,)`` int64 times in a folder's ``times.txt``, without one those of a steady rate."""
    path = folder / _TIMES_NAME
    return _read_times_ns(path) if path.is_file() else nominal_times_ns(num_images, rate_hz)
