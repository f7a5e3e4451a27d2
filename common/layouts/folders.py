"""Folders of images: semcast's own layout, and those without one."""

from pathlib import Path

from semcast.common.layouts.files import (
    SequenceFiles,
    calibration_beside,
    images_in,
    times_beside,
    truth_beside,
)


def read_native(path: Path, rate_hz: float) -> SequenceFiles:
    """Read semcast's own layout: ``images/``, and what lies beside it."""
    return _with_what_lies_beside(path, images_in(path / "images"), rate_hz)


def read_folder(path: Path, rate_hz: float) -> SequenceFiles:
    """Read a folder of images."""
    return _with_what_lies_beside(path, images_in(path), rate_hz)


def _with_what_lies_beside(path: Path, images: tuple[Path, ...], rate_hz: float) -> SequenceFiles:
    times_ns = times_beside(path, len(images), rate_hz)
    return SequenceFiles(path.resolve().name, images, times_ns, calibration_beside(path), truth_beside(path))
