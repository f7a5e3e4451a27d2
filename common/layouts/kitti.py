"""KITTI odometry."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import make_transform, project_to_so3
from semcast.common.layouts.files import (
    SequenceFiles,
    calibration_beside,
    check_times,
    finite_numbers,
    images_in,
    rows_of,
    times_beside,
)
from semcast.common.numbered_images import lines_of_images, numbers_in_names
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory

logger = logging.getLogger(__name__)


def kitti_camera(path: Path) -> int | None:
    """Return the number of the camera whose images a KITTI sequence has, colour and left first; else None."""
    return next((k for k in (2, 0, 3, 1) if (path / f"image_{k}").is_dir()), None)


def read_kitti(path: Path, rate_hz: float) -> SequenceFiles:
    """Read KITTI odometry; poses are of camera 0 and are moved to the camera used by its baseline."""
    camera_idx = kitti_camera(path)
    if camera_idx is None:
        raise SourceError(f"{path} must have image_2 or image_0 to be a KITTI sequence")
    images = images_in(path / f"image_{camera_idx}")
    times_ns = _kitti_times_ns(path, images, rate_hz)
    projection = _kitti_projection(path / "calib.txt", camera_idx)
    name = path.resolve().name
    poses_path = next((place for place in kitti_pose_places(path) if place.is_file()), None)
    truth = None
    if poses_path is not None:
        check_times(path, len(images), times_ns)
        poses = _kitti_poses(poses_path)
        if projection is not None:
            t_cam_cam0 = np.linalg.solve(projection[:, :3], projection[:, 3])
            poses = poses @ make_transform(np.eye(3), -t_cam_cam0)
        if len(poses) < len(times_ns):
            raise SourceError(f"{poses_path} must have a pose per image, got {len(poses)} of {len(times_ns)}")
        lines = lines_of_images(images, len(poses))
        if lines is None and numbers_in_names(images):
            raise SourceError(f"{poses_path} has {len(poses)} poses: none for image {images[-1].name}")
        # Images with other names are taken for the first ones.
        truth = Trajectory(ns_to_seconds(times_ns), poses[lines if lines is not None else slice(len(images))])

    def camera(width: int, height: int) -> Intrinsics | None:
        if projection is None:
            return calibration_beside(path)(width, height)
        (fx, _, cx, _), (_, fy, cy, _), _ = projection.tolist()
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    return SequenceFiles(name, images, times_ns, camera, truth)


def _kitti_times_ns(path: Path, images: tuple[Path, ...], rate_hz: float) -> NDArray[np.int64]:
    times_ns = times_beside(path, len(images), rate_hz)
    lines = lines_of_images(images, len(times_ns))
    if lines is None or len(lines) == len(times_ns):
        return times_ns
    logger.info(
        "%s has %d of %d images: times and poses are those of their numbers", path, len(lines), len(times_ns)
    )
    return times_ns[lines]


def kitti_pose_places(path: Path) -> tuple[Path, Path, Path]:
    """Return where the true poses of a KITTI sequence may be: in its folder, or ``poses/`` beside its parent.

    The root of a file system is its own parent.
    """
    folder = path.resolve()
    name = f"{folder.name}.txt"
    return folder / "poses.txt", folder / name, folder.parent.parent / "poses" / name


def _kitti_projection(path: Path, camera_idx: int) -> NDArray[np.float64] | None:
    if not path.is_file():
        return None
    for label, *numbers in rows_of(path, 1, lambda row: row.fields):
        if label.rstrip(":") == f"P{camera_idx}":
            try:
                projection = finite_numbers(numbers, 12).reshape(3, 4)
            except ValueError as err:
                raise SourceError(f"{path}: P{camera_idx} {err}") from err
            if not (projection[0, 0] > 0 and projection[1, 1] > 0 and projection[2, 2] > 0):
                raise SourceError(
                    f"{path}: P{camera_idx} must have positive focal lengths, got {' '.join(numbers)}"
                )
            return projection
    raise SourceError(f"{path} has no line P{camera_idx}")


def _kitti_poses(path: Path) -> NDArray[np.float64]:
    rows = rows_of(path, 12, lambda row: finite_numbers(row.fields, 12).reshape(3, 4))
    return np.array([make_transform(project_to_so3(row[:, :3]), row[:, 3]) for row in rows]).reshape(-1, 4, 4)
