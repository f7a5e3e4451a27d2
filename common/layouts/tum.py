"""The TUM RGB-D benchmark."""

from pathlib import Path

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.layouts.files import SequenceFiles, calibration_beside, image_name, rows_of, truth_beside
from semcast.common.times import seconds_to_ns

#: Calibration published with the TUM RGB-D benchmark (Sturm et al. 2012), which its folders don't hold.
_TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, ()),
}


def read_tum_folder(path: Path, rate_hz: float) -> SequenceFiles:
    """Read a folder of the TUM RGB-D benchmark: ``rgb.txt`` and what it names."""
    del rate_hz
    rows = rows_of(path / "rgb.txt", 2, lambda row: (seconds_to_ns(row.fields[0]), path / image_name(row)))
    beside = calibration_beside(path)
    name = path.resolve().name

    def camera(width: int, height: int) -> Intrinsics | None:
        own = beside(width, height)
        known = next((values for key, values in _TUM_CAMERAS.items() if key in name), None)
        if own is not None or known is None:
            return own
        fx, fy, cx, cy, distortion = known
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=640, height=480, distortion=distortion)

    return SequenceFiles(
        name,
        tuple(image for _, image in rows),
        np.array([t for t, _ in rows], dtype=np.int64),
        camera,
        truth_beside(path),
    )
