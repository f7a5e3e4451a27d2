"""Which folder layout a recorded sequence has, and what it consists of: which files, when, which camera.

Images are not opened here. Poses are brought to ``T_world_cam`` of the camera whose images are used.
"""

import contextlib
import itertools
import logging
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

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

#: Folders below one without a sequence that are looked into.
_MOST_FOLDERS = 200
#: Time between images from which it is more likely given in milliseconds.
_LONG_GAP_S = 10.0

Layout = Literal["auto", "native", "tum", "kitti", "euroc", "transforms", "colmap", "folder"]


def find_layout(path: Path) -> Layout:
    """Tell the layout of a folder or transforms file.

    Raises:
        SourceError: There is no such file or folder, or it holds nothing known.
    """
    _check_there(path)
    if path.is_file():
        return "transforms"
    layout = _layout_of(path)
    if layout is None:
        rest = _below(path) or (
            ": expected images/ (native), rgb.txt (TUM), image_2/ or image_0/ (KITTI), mav0/cam0/ (EuRoC), "
            "transforms.json (NeRF), images/ and sparse/ (COLMAP), or image files "
            f"({' '.join(IMAGE_SUFFIXES)})"
        )
        raise SourceError(f"no sequence at {path}{rest}")
    if layout == "native" and not _has_native_names(path) and (lack := half_a_model(path)):
        logger.warning("%s: images are read without it, and so without camera and poses", lack)
    return layout


def _layout_of(path: Path) -> Layout | None:
    """Tell the layout of a folder, None where it holds nothing known."""
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
        return "native" if _has_native_names(path) or colmap_folder(path) is None else "colmap"
    return "folder" if images_in(path) else None


def _has_native_names(path: Path) -> bool:
    return any((path / name).is_file() for name in NATIVE_NAMES)


def _below(path: Path) -> str:
    """Say which sequences there are in folders of this one, as in the unpacked archive of a data set."""
    folders = itertools.chain.from_iterable(path.glob(pattern) for pattern in ("*/", "*/*/"))
    found: list[Path] = []
    for folder in sorted(itertools.islice(folders, _MOST_FOLDERS)):
        with contextlib.suppress(OSError):  # one that may not be looked into
            if folder.parent not in found and _layout_of(folder) is not None:
                found.append(folder)
    if not found:
        return ""
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return f" itself, but at {found[0]}{more}"


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
    gap_s = float(np.median(np.diff(files.times_ns))) * 1e-9 if len(files.times_ns) > 1 else 0.0
    if gap_s >= _LONG_GAP_S:
        logger.warning("images of %s are %g s apart: are these times in seconds?", path, gap_s)
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
