"""Pictures with poses that others estimated: ``transforms.json`` of NeRF, and COLMAP models."""

import logging
from pathlib import Path

from semcast.common.colmap_file import colmap_folder, read_colmap
from semcast.common.errors import SourceError
from semcast.common.image_order import order_of
from semcast.common.layouts.files import IMAGE_SUFFIXES, SequenceFiles, images_in, nominal_times_ns
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory
from semcast.common.transforms_file import read_transforms_json

logger = logging.getLogger(__name__)
TRANSFORMS_NAMES = ("transforms.json", "transforms_test.json", "transforms_train.json")


def read_transforms(path: Path, rate_hz: float) -> SequenceFiles:
    """Read a ``transforms.json`` of NeRF, or a folder with one."""
    if path.is_dir():
        found = next((path / name for name in TRANSFORMS_NAMES if (path / name).is_file()), None)
        if found is None:
            raise SourceError(f"{path} has no transforms.json, transforms_test.json or transforms_train.json")
        path = found
    file = read_transforms_json(path, IMAGE_SUFFIXES)
    times_ns = nominal_times_ns(len(file.image_paths), rate_hz)
    truth = Trajectory(ns_to_seconds(times_ns), file.T_world_cam, in_metres=False)
    return SequenceFiles(path.resolve().parent.name, file.image_paths, times_ns, file.camera, truth)


def read_colmap_model(path: Path, rate_hz: float) -> SequenceFiles:
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
    times_ns = nominal_times_ns(len(order), rate_hz)
    return SequenceFiles(
        path.resolve().name,
        tuple(path / "images" / model.names[k] for k in order),
        times_ns,
        model.camera_of,
        Trajectory(ns_to_seconds(times_ns), model.T_world_cam[order], in_metres=False),
    )
