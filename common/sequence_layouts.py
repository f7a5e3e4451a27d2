"""What a recorded sequence consists of, read from the folder layouts in use: which files, when, which camera.

Images are not opened here. Poses are brought to ``T_world_cam`` of the camera whose images are used.
"""

import logging
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.camera_file import read_flat_yaml, read_intrinsics, transform_from_yaml
from semcast.common.colmap_file import colmap_folder, half_a_model, read_colmap
from semcast.common.errors import SourceError
from semcast.common.geometry import make_transform, project_to_so3, rotation_from_quat_wxyz
from semcast.common.image_order import in_order, order_of
from semcast.common.numbered_images import lines_of_images, numbers_in_names
from semcast.common.ros_bag_files import check_no_ros_bag
from semcast.common.text_rows import TextRow, text_rows
from semcast.common.trajectory import Trajectory, read_tum, seconds_of
from semcast.common.transforms_file import read_transforms_json

logger = logging.getLogger(__name__)

Row = TypeVar("Row")

Layout = Literal["auto", "native", "tum", "kitti", "euroc", "transforms", "colmap", "folder"]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")
_ENDINGS = "|".join(suffix[1:] for suffix in IMAGE_SUFFIXES)
#: What follows the time in a line of a list of images, as far as the first end of an image's name.
_IMAGE_NAME = re.compile(rf"[^\s,]+[\s,]+(.+?\.({_ENDINGS}))(?=[\s,]|$)", re.IGNORECASE)
_TRANSFORMS_NAMES = ("transforms.json", "transforms_test.json", "transforms_train.json")
_CALIBRATION_NAMES = ("intrinsics.json", "intrinsics.yaml", "camera.yaml", "calibration.yaml", "sensor.yaml")
_TIMES_NAME = "times.txt"
_TRUTH_NAME = "groundtruth.txt"
#: Files of semcast's own layout, beside ``images/``.
_NATIVE_NAMES = (*_CALIBRATION_NAMES, _TIMES_NAME, _TRUTH_NAME)
#: Calibration published with the TUM RGB-D benchmark (Sturm et al. 2012), which its folders don't hold.
_TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, ()),
}


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


#: The year 2255; nanoseconds beyond 2262 are no 64-bit number.
_MAX_TIME_S = 9_000_000_000
_MAX_TIME_NS = _MAX_TIME_S * 10**9
#: Times since 1970 in milliseconds stay below this for as long.
_MAX_TIME_MS = _MAX_TIME_S * 10**3


def seconds_to_ns(text: str) -> int:
    """Convert decimal seconds to nanoseconds without passing through a float.

    Raises:
        ValueError: Not a finite number, or too large for seconds since 1970.
    """
    try:
        time_s = Decimal(text)
    except InvalidOperation as err:
        raise ValueError(f"time must be a number of seconds, got {text!r}") from err
    if not time_s.is_finite():
        raise ValueError(f"time must be a number of seconds, got {text!r}")
    # Not abs(), which overflows at exponents that Decimal itself takes.
    if time_s.copy_abs() > _MAX_TIME_S:
        raise ValueError(_not_seconds(text, float(time_s)))
    return int((time_s * 1_000_000_000).to_integral_value())


def _not_seconds(text: str, time_s: float) -> str:
    unit = "milliseconds" if abs(time_s) <= _MAX_TIME_MS else "micro- or nanoseconds"
    return f"times must be in seconds, got {text}: looks like {unit}"


def ns_to_seconds(times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return ``times_ns * 1e-9``: the one conversion, so that equal frames have equal times."""
    return np.asarray(times_ns * 1e-9, dtype=np.float64)


def find_layout(path: Path) -> Layout:
    """Tell the layout of a folder or transforms file.

    Raises:
        SourceError: There is no such file or folder, or it holds nothing known.
    """
    _check_there(path)
    if path.is_file():
        return "transforms"
    if _euroc_camera_folder(path) is not None:
        return "euroc"
    if (path / "rgb.txt").is_file():
        return "tum"
    if _kitti_camera(path) is not None:
        return "kitti"
    has_transforms = any((path / name).is_file() for name in _TRANSFORMS_NAMES)
    has_images = (path / "images").is_dir()
    if has_images and (path / "intrinsics.json").is_file():
        return "native"
    if has_transforms:
        return "transforms"
    if has_images:
        is_native = any((path / name).is_file() for name in _NATIVE_NAMES)
        if not is_native and (lack := half_a_model(path)):
            logger.warning("%s: images are read without it, and so without camera and poses", lack)
        return "native" if is_native or colmap_folder(path) is None else "colmap"
    if images_in(path):
        return "folder"
    raise SourceError(
        f"no sequence at {path}: expected images/ (native), rgb.txt (TUM), image_2/ or image_0/ (KITTI), "
        "mav0/cam0/ (EuRoC), transforms.json (NeRF), images/ and sparse/ (COLMAP), or image files "
        f"({' '.join(IMAGE_SUFFIXES)})"
    )


def read_layout(path: Path, layout: Layout, rate_hz: float) -> SequenceFiles:
    """Read a recording's files.

    Args:
        path: Folder, or a transforms file.
        layout: One of ``Layout``; ``auto`` looks.
        rate_hz: Frame rate of layouts that record no times.

    Raises:
        SourceError: A part is missing or damaged.
    """
    readers: dict[str, Callable[[Path, float], SequenceFiles]] = {
        "native": _read_native,
        "tum": _read_tum_folder,
        "kitti": _read_kitti,
        "euroc": _read_euroc,
        "transforms": _read_transforms,
        "colmap": _read_colmap,
        "folder": _read_folder,
    }
    _check_there(path)
    files = readers[find_layout(path) if layout == "auto" else layout](path, rate_hz)
    if not files.image_paths:
        raise SourceError(f"no images in {path}")
    _check_times(path, len(files.image_paths), files.times_ns)
    return files


def _check_times(path: Path, num_images: int, times_ns: NDArray[np.int64]) -> None:
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


def _check_there(path: Path) -> None:
    check_no_ros_bag(path)
    if path.is_file():
        if path.suffix.lower() != ".json":
            name = shlex.quote(str(path))
            way = f"videos go through: semcast demo --sequence {name}, or semcast agent --source {name}"
            if path.suffix.lower() == ".mcap":
                way = f"recordings of a stream go through: {shlex.join(('semcast', 'replay', str(path)))}"
            raise SourceError(
                f"a sequence must be a folder or a transforms .json file, got the file {path}: {way}"
            )
    elif not path.is_dir():
        what = "that is a pipe, socket or device" if path.exists() else "there is no such file or folder"
        raise SourceError(f"no sequence at {path}: {what}")


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


def _nominal_times_ns(count: int, rate_hz: float) -> NDArray[np.int64]:
    return np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def _rows(path: Path, at_least: int, read: Callable[[TextRow], Row]) -> list[Row]:
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


def _image_name(row: TextRow) -> str:
    """Return the second field; blanks and commas may be part of it."""
    found = _IMAGE_NAME.match(row.line.split("#", 1)[0].strip())
    return found[1] if found else row.fields[1]


def _finite(numbers: list[str], count: int) -> NDArray[np.float64]:
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
    return np.array(_rows(path, 1, lambda row: seconds_to_ns(row.fields[0])), dtype=np.int64)


def _calibration_beside(folder: Path) -> Callable[[int, int], Intrinsics | None]:
    found = [folder / name for name in _CALIBRATION_NAMES if (folder / name).is_file()]
    return lambda width, height: read_intrinsics(found[0]) if found else None


def _truth_beside(folder: Path) -> Trajectory | None:
    path = folder / _TRUTH_NAME
    truth = read_tum(path) if path.is_file() else None
    if truth is not None and len(truth) and np.abs(truth.t_s).max() > _MAX_TIME_S:
        latest = float(np.abs(truth.t_s).max())
        raise SourceError(f"{path}: {_not_seconds(f'{latest:.0f}', latest)}")
    return truth


def _times_beside(folder: Path, num_images: int, rate_hz: float) -> NDArray[np.int64]:
    path = folder / _TIMES_NAME
    return _read_times_ns(path) if path.is_file() else _nominal_times_ns(num_images, rate_hz)


def _read_native(path: Path, rate_hz: float) -> SequenceFiles:
    return _with_what_lies_beside(path, images_in(path / "images"), rate_hz)


def _read_folder(path: Path, rate_hz: float) -> SequenceFiles:
    return _with_what_lies_beside(path, images_in(path), rate_hz)


def _with_what_lies_beside(path: Path, images: tuple[Path, ...], rate_hz: float) -> SequenceFiles:
    times_ns = _times_beside(path, len(images), rate_hz)
    return SequenceFiles(
        path.resolve().name, images, times_ns, _calibration_beside(path), _truth_beside(path)
    )


def _read_tum_folder(path: Path, rate_hz: float) -> SequenceFiles:
    del rate_hz
    rows = _rows(path / "rgb.txt", 2, lambda row: (seconds_to_ns(row.fields[0]), path / _image_name(row)))
    beside = _calibration_beside(path)
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
        _truth_beside(path),
    )


def _kitti_camera(path: Path) -> int | None:
    return next((k for k in (2, 0, 3, 1) if (path / f"image_{k}").is_dir()), None)


def _read_kitti(path: Path, rate_hz: float) -> SequenceFiles:
    """Read KITTI odometry; poses are of camera 0 and are moved to the camera used by its baseline."""
    camera_idx = _kitti_camera(path)
    if camera_idx is None:
        raise SourceError(f"{path} must have image_2 or image_0 to be a KITTI sequence")
    images = images_in(path / f"image_{camera_idx}")
    times_ns = _kitti_times_ns(path, images, rate_hz)
    projection = _kitti_projection(path / "calib.txt", camera_idx)
    name = path.resolve().name
    poses_path = next((place for place in kitti_pose_places(path) if place.is_file()), None)
    truth = None
    if poses_path is not None:
        _check_times(path, len(images), times_ns)
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
            return _calibration_beside(path)(width, height)
        (fx, _, cx, _), (_, fy, cy, _), _ = projection.tolist()
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    return SequenceFiles(name, images, times_ns, camera, truth)


def _kitti_times_ns(path: Path, images: tuple[Path, ...], rate_hz: float) -> NDArray[np.int64]:
    times_ns = _times_beside(path, len(images), rate_hz)
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
    for label, *numbers in _rows(path, 1, lambda row: row.fields):
        if label.rstrip(":") == f"P{camera_idx}":
            try:
                projection = _finite(numbers, 12).reshape(3, 4)
            except ValueError as err:
                raise SourceError(f"{path}: P{camera_idx} {err}") from err
            if not (projection[0, 0] > 0 and projection[1, 1] > 0 and projection[2, 2] > 0):
                raise SourceError(
                    f"{path}: P{camera_idx} must have positive focal lengths, got {' '.join(numbers)}"
                )
            return projection
    raise SourceError(f"{path} has no line P{camera_idx}")


def _kitti_poses(path: Path) -> NDArray[np.float64]:
    rows = _rows(path, 12, lambda row: _finite(row.fields, 12).reshape(3, 4))
    return np.array([make_transform(project_to_so3(row[:, :3]), row[:, 3]) for row in rows]).reshape(-1, 4, 4)


def _euroc_camera_folder(path: Path) -> Path | None:
    places = (path / "mav0" / "cam0", path / "cam0", path)
    return next((p for p in places if (p / "data.csv").is_file() and (p / "data").is_dir()), None)


def _read_euroc(path: Path, rate_hz: float) -> SequenceFiles:
    del rate_hz
    folder = _euroc_camera_folder(path)
    if folder is None:
        raise SourceError(f"{path} must have mav0/cam0/data.csv and mav0/cam0/data to be a EuRoC sequence")
    rows = _rows(
        folder / "data.csv", 2, lambda row: (_whole_ns(row.fields[0]), folder / "data" / _image_name(row))
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
    if abs(time_ns) > _MAX_TIME_NS:
        raise ValueError(f"time must be within {_MAX_TIME_NS} ns, got {text}")
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
        px, py, pz, *quat_wxyz = _finite(row.fields[1:8], 7).tolist()
        T_world_body = make_transform(rotation_from_quat_wxyz(quat_wxyz), (px, py, pz))
        return _whole_ns(row.fields[0]), T_world_body @ T_body_cam

    rows = _rows(path, 8, pose)
    times_ns = np.array([t_ns for t_ns, _ in rows], np.int64)
    try:
        return Trajectory(ns_to_seconds(times_ns), np.array([T for _, T in rows]).reshape(-1, 4, 4))
    except ValueError as err:
        raise SourceError(f"{path}: {err}") from err


def _read_transforms(path: Path, rate_hz: float) -> SequenceFiles:
    if path.is_dir():
        found = next((path / name for name in _TRANSFORMS_NAMES if (path / name).is_file()), None)
        if found is None:
            raise SourceError(f"{path} has no transforms.json, transforms_test.json or transforms_train.json")
        path = found
    file = read_transforms_json(path, IMAGE_SUFFIXES)
    times_ns = _nominal_times_ns(len(file.image_paths), rate_hz)
    truth = Trajectory(ns_to_seconds(times_ns), file.T_world_cam, in_metres=False)
    return SequenceFiles(path.resolve().parent.name, file.image_paths, times_ns, file.camera, truth)


def _read_colmap(path: Path, rate_hz: float) -> SequenceFiles:
    """Read the images that the model has a pose of; the others of the folder are left out."""
    folder = colmap_folder(path)
    if folder is None:
        raise SourceError(f"{path} must have sparse/0/cameras.bin and images.bin, or .txt, of COLMAP")
    model = read_colmap(folder)
    order = order_of(model.names)
    num_there = len(images_in(path / "images"))
    if num_there > len(order):
        logger.info(
            "%s has %d images, of which COLMAP has posed %d: these are used", path, num_there, len(order)
        )
    times_ns = _nominal_times_ns(len(order), rate_hz)
    return SequenceFiles(
        path.resolve().name,
        tuple(path / "images" / model.names[k] for k in order),
        times_ns,
        model.camera_of,
        Trajectory(ns_to_seconds(times_ns), model.T_world_cam[order], in_metres=False),
    )
