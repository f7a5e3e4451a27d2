"""Which folder layout a recorded sequence has, and what it consists of: which files, when, which camera.

Images are not opened here. Poses are brought to ``T_world_cam`` of the camera whose images are used.
"""

import logging
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from semcast.common.colmap_file import colmap_folder, half_a_model
from semcast.common.errors import SourceError
from semcast.common.layouts.euroc import euroc_camera_folder, read_euroc
from semcast.common.layouts.files import IMAGE_SUFFIXES, NATIVE_NAMES, SequenceFiles, check_times, images_in
from semcast.common.layouts.folders import read_folder, read_native
from semcast.common.layouts.kitti import kitti_camera, read_kitti
from semcast.common.layouts.models import TRANSFORMS_NAMES, read_colmap_model, read_transforms
from semcast.common.layouts.tum import read_tum_folder
from semcast.common.ros_bag_files import check_no_ros_bag

logger = logging.getLogger(__name__)

Layout = Literal["auto", "native", "tum", "kitti", "euroc", "transforms", "colmap", "folder"]


def find_layout(path: Path) -> Layout:
    """Tell the layout of a folder or transforms file.

    Raises:
        SourceError: There is no such file or folder, or it holds nothing known.
    """
    _check_there(path)
    if path.is_file():
        return "transforms"
    if euroc_camera_folder(path) is not None:
        return "euroc"
    if (path / "rgb.txt").is_file():
        return "tum"
    if kitti_camera(path) is not None:
        return "kitti"
    has_transforms = any((path / name).is_file() for name in TRANSFORMS_NAMES)
    has_images = (path / "images").is_dir()
    if has_images and (path / "intrinsics.json").is_file():
        return "native"
    if has_transforms:
        return "transforms"
    if has_images:
        is_native = any((path / name).is_file() for name in NATIVE_NAMES)
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
        "native": read_native,
        "tum": read_tum_folder,
        "kitti": read_kitti,
        "euroc": read_euroc,
        "transforms": read_transforms,
        "colmap": read_colmap_model,
        "folder": read_folder,
    }
    _check_there(path)
    files = readers[find_layout(path) if layout == "auto" else layout](path, rate_hz)
    if not files.image_paths:
        raise SourceError(f"no images in {path}")
    check_times(path, len(files.image_paths), files.times_ns)
    return files


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
