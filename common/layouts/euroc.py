"""EuRoC recordings."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera_file import read_flat_yaml, read_intrinsics, transform_from_yaml
from semcast.common.errors import SourceError
from semcast.common.geometry import make_transform, rotation_from_quat_wxyz
from semcast.common.layouts.files import SequenceFiles, finite_numbers, image_name, rows_of
from semcast.common.text_rows import TextRow
from semcast.common.times import MAX_TIME_NS, ns_to_seconds
from semcast.common.trajectory import Trajectory


def euroc_camera_folder(path: Path) -> Path | None:
    """Return the folder of a EuRoC recording's first camera, None where there is none."""
    places = (path / "mav0" / "cam0", path / "cam0", path)
    return next((p for p in places if (p / "data.csv").is_file() and (p / "data").is_dir()), None)


def read_euroc(path: Path, rate_hz: float) -> SequenceFiles:
    """Read a EuRoC recording; poses are of the body and are moved to the camera."""
    del rate_hz
    folder = euroc_camera_folder(path)
    if folder is None:
        raise SourceError(f"{path} must have mav0/cam0/data.csv and mav0/cam0/data to be a EuRoC sequence")
    rows = rows_of(
        folder / "data.csv", 2, lambda row: (_whole_ns(row.fields[0]), folder / "data" / image_name(row))
    )
    sensor = folder / "sensor.yaml"
    name = path.resolve().name
    return SequenceFiles(
        name if name != "mav0" else path.resolve().parent.name,
        tuple(image for _, image in rows),
        np.array([t for t, _ in rows], dtype=np.int64),
        lambda width, height: read_intrinsics(sensor) if sensor.is_file() else None,
        _euroc_truth(folder.parent / "state_groundtruth_estimate0" / "data.csv", sensor),
    )


def _whole_ns(text: str) -> int:
    try:
        time_ns = int(text)
    except ValueError as err:
        raise ValueError(f"time must be whole nanoseconds, got {text!r}") from err
    if abs(time_ns) > MAX_TIME_NS:
        raise ValueError(f"time must be within {MAX_TIME_NS} ns, got {text}")
    return time_ns


def _euroc_truth(path: Path, sensor: Path) -> Trajectory | None:
    """Return camera poses: body poses of the estimate times the camera's ``T_BS``."""
    if not path.is_file() or not sensor.is_file():
        return None
    try:
        T_body_cam = transform_from_yaml(read_flat_yaml(sensor), "T_BS")
    except ValueError as err:
        raise SourceError(f"{sensor} has no usable T_BS: {err}") from err
    if T_body_cam is None:
        raise SourceError(f"{sensor} has no T_BS")

    def pose(row: TextRow) -> tuple[int, NDArray[np.float64]]:
        px, py, pz, *quat_wxyz = finite_numbers(row.fields[1:8], 7).tolist()
        T_world_body = make_transform(rotation_from_quat_wxyz(quat_wxyz), (px, py, pz))
        return _whole_ns(row.fields[0]), T_world_body @ T_body_cam

    rows = rows_of(path, 8, pose)
    times_ns = np.array([t_ns for t_ns, _ in rows], np.int64)
    try:
        return Trajectory(ns_to_seconds(times_ns), np.array([T for _, T in rows]).reshape(-1, 4, 4))
    except ValueError as err:
        raise SourceError(f"{path}: {err}") from err
