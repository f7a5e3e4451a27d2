"""Exports of a run folder by format name."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from semcast.common.errors import ConfigError, SemcastError, SourceError
from semcast.common.run_folder import (
    DENSE_NAME,
    IMAGES_NAME,
    RUN_FILES,
    RunData,
    read_image_paths,
    read_run,
)
from semcast.server.export.colmap import write_colmap
from semcast.server.export.nerfstudio import write_nerfstudio
from semcast.server.export.outputs import MAP_FRAME, read_ply, write_ply
from semcast.server.export.parts import ALL, LARGEST, count_parts, parts_line, select_part
from semcast.server.export.placement import Placement
from semcast.server.export.poses import write_run_kitti, write_run_tum
from semcast.server.export.replacement import MODEL_LISTS, exported_formats, replacing_model

logger = logging.getLogger(__name__)

#: Format -> what is written where, for the help.
FORMATS = {
    "tum": "FILE with 't tx ty tz qx qy qz qw' (evo)",
    "kitti": "FILE with 3x4 poses, times and frame ids beside it (evo)",
    "ply": "FILE with the points (CloudCompare, MeshLab, Open3D)",
    "dense": "FILE with the points of the dense cloud (the same)",
    "colmap": "FOLDER with sparse/0/*.txt and images/ (COLMAP, pycolmap)",
    "nerfstudio": "FOLDER with transforms.json, points and images/ (nerfstudio, gsplat)",
    "rrd": "FILE for the Rerun viewer",
}


#: Finds the frame to export in, from a run of one part and the images it kept.
FindPlacement = Callable[[RunData, Mapping[int, Path]], Placement]


class Export(NamedTuple):
    """What was written.

    Attributes:
        files: Those a person opens.
        data: The run as it was exported: the part, placed.
    """

    files: list[Path]
    data: RunData


def export_run(
    folder: Path, format_name: str, out: Path, part: str = ALL, find_placement: FindPlacement | None = None
) -> Export:
    """Write a run in another tool's format.

    Several parts in one model are told as a warning.

    Args:
        folder: A run folder.
        format_name: One of ``FORMATS``.
        out: File or folder, as ``FORMATS`` says.
        part: Part of the map: its number, ``largest`` or ``all``.
        find_placement: Where another frame and unit than the map's own come from.

    Raises:
        SourceError: The run can't be read, has no such part, lacks what the format needs, or can't be placed.
        ConfigError: ``out`` is a folder with somebody else's images or the run's own place, or parts or
            format can't be placed.
        SemcastError: ``out`` can't be written.
        ValueError: ``format_name`` is none of ``FORMATS``, or ``part`` neither a number nor a word for parts.
    """
    if format_name not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {format_name!r}")
    _check_not_of_run(out, folder)
    data = read_run(folder)
    if len(data.frame_ids) == 0:
        raise SourceError(f"{folder} has no posed frame, so there is nothing to export")
    parts = parts_line(count_parts(data.frame_submap.tolist()))
    whole = parts is None or part == ALL
    data = select_part(data, part)
    if format_name == "dense" and not whole:
        raise ConfigError("--part must be all for --format dense: its points do not know their part")
    images = read_image_paths(folder)
    placement = None
    if find_placement is not None:
        _check_placeable(format_name, part, parts)
        placement = find_placement(data, images)
        logger.info("%s", placement.words)
        data = placement.run(data)
    elif format_name != "rrd" and any(known.part in data.frame_submap for known in data.metres):
        logger.info("in the map's own unit; the run knows the metre: --metres writes in it")
    frame = MAP_FRAME if placement is None else placement.frame
    _check_kind(out, format_name)
    writers: dict[str, Callable[[], list[Path]]] = {
        "tum": lambda: write_run_tum(out, data),
        "kitti": lambda: write_run_kitti(out, data),
        "ply": lambda: _write_run_ply(out, data, frame),
        "dense": lambda: _write_run_dense(out, folder, placement),
        "colmap": lambda: _write_model(out, "colmap", lambda place: write_colmap(place, data, images)),
        "nerfstudio": lambda: _write_model(
            out,
            "nerfstudio",
            lambda place: write_nerfstudio(place, data, images, placement.frame if placement else None),
        ),
        # The server's own recording shows all parts.
        "rrd": lambda: _write_run_rrd(out, folder, data, images, copy=whole),
    }
    if parts is not None and part == ALL:
        logger.warning("parts of the map: %s; --part %s writes one that fits together", parts, LARGEST)
    try:
        if FORMATS[format_name].startswith("FOLDER"):
            _check_not_foreign(out, format_name, images)
        return Export(writers[format_name](), data)
    except OSError as err:
        raise SemcastError(f"{out} can't be written: {err}") from err


def _check_placeable(format_name: str, part: str, parts: str | None) -> None:
    """Refuse what can't be moved to another frame and unit.

    Args:
        format_name: One of ``FORMATS``.
        part: As asked for.
        parts: The parts of the map in words; None where it is of one.
    """
    if format_name == "rrd":
        raise ConfigError(
            "--format rrd shows the map in its own frame, without --align, --metres or --marker-m"
        )
    if parts is not None and format_name == "dense":
        raise ConfigError(
            f"--format dense can't be placed here: each part has its own scale ({parts}), and "
            "points of the dense cloud do not know their part"
        )
    if parts is not None and part == ALL:
        raise ConfigError(f"--part must name one part, each has its own scale: {parts}")


def _check_not_of_run(out: Path, folder: Path) -> None:
    """Refuse what the run itself is made of: once moved and scaled, it would be so again the next time."""
    run, place = folder.resolve(), out.resolve()
    own = {run, *(run / name for name in RUN_FILES)}
    if place in own or run / IMAGES_NAME in (place, *place.parents):
        raise ConfigError(f"out must be another place than the run itself and its files, got {out}")


def _check_kind(out: Path, format_name: str) -> None:
    """Refuse a folder where the format is a file, the other way round, and a place below a file."""
    for parent in out.parents:
        if parent.exists() and not parent.is_dir():
            raise SourceError(f"{out} can't be written: {parent} is a file, not a folder")
    if FORMATS[format_name].startswith("FILE") and out.is_dir():
        raise SourceError(f"{out} is a folder; --format {format_name} writes a file")
    if FORMATS[format_name].startswith("FOLDER") and out.is_file():
        raise SourceError(f"{out} is a file; --format {format_name} writes a folder")


def _check_not_foreign(out: Path, format_name: str, images: Mapping[int, Path]) -> None:
    """Refuse a folder with images or a model that others need: they would be written over.

    Those of an earlier export in the same format are; those that the other format's model shows must stay.
    An export that found no room has left some of its images, and no list of them.
    """
    exported = exported_formats(out)
    if exported == {format_name}:
        return
    ours = {path.name: path for path in images.values()}
    there = sorted((out / "images").iterdir()) if (out / "images").is_dir() else []
    if exported:
        there = [f for f in there if f.name in ours]
    foreign = [
        f for f in there if f.name not in ours or f.is_dir() or f.read_bytes() != ours[f.name].read_bytes()
    ]
    foreign += [out / path for f, path in MODEL_LISTS.items() if f not in exported and (out / path).exists()]
    if foreign:
        raise ConfigError(f"out must hold no images of others, there is {foreign[0]}: give another folder")


def _write_model(out: Path, format_name: str, write: Callable[[Path], list[Path]]) -> list[Path]:
    """Write a model with pictures in place of the one that may be there, and return its files."""
    with replacing_model(out, format_name) as place:
        files = write(place)
    return [out / file.relative_to(place) for file in files]


def _write_run_ply(path: Path, data: RunData, frame: str) -> list[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, data.xyz, data.rgb, data.confidence, frame=frame)
    return [path]


def _write_run_dense(path: Path, folder: Path, placement: Placement | None) -> list[Path]:
    if not (folder / DENSE_NAME).is_file():
        raise SourceError(f"{folder} has no dense cloud; run again with --dense-cloud live or end")
    cloud = read_ply(folder / DENSE_NAME)
    xyz = np.stack([cloud[axis] for axis in "xyz"], axis=1)
    rgb = np.stack([cloud[colour] for colour in ("red", "green", "blue")], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(
        path,
        placement.points(xyz) if placement else xyz,
        rgb,
        cloud["confidence"],
        frame=placement.frame if placement else MAP_FRAME,
    )
    return [path]


def _write_run_rrd(
    path: Path, folder: Path, data: RunData, images: dict[int, Path], *, copy: bool
) -> list[Path]:
    from semcast.server.export.rrd import write_rrd  # loads rerun

    return write_rrd(path, folder, data, images, copy=copy)
