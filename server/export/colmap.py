"""COLMAP's text model of a run: cameras, images with keypoints, points with tracks, and the pictures.

COLMAP stores ``T_cam_world`` with the quaternion ``qw qx qy qz``, and its pixel centres are at half integers,
half a pixel more than ours (https://colmap.github.io/format.html).
"""

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, quat_wxyz_from_rotation
from semcast.common.run_folder import RunData, image_name
from semcast.common.whole_file import write_whole
from semcast.server.export.geometry import landmark_rows, reprojection_errors_px, unique_observations

logger = logging.getLogger(__name__)

PIXEL_CENTRE = 0.5
CAMERA_ID = 1
#: First line of ``images.txt``: COLMAP's own begins otherwise, so by this an export is known.
IMAGES_HEADER = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


def exported_frame_ids(data: RunData, images: Mapping[int, Path]) -> list[int]:
    """Return the frames that go into models with pictures: keyframes, and posed frames with a kept image."""
    posed = set(data.frame_ids.tolist())
    return sorted(set(data.keyframe_ids.tolist()) | (posed & set(images)))


def copy_images(images: Mapping[int, Path], frame_ids: list[int], folder: Path) -> int:
    """Copy the kept images of these frames and return how many there were.

    Args:
        images: Frame id to file of the kept images.
        frame_ids: Frames that are wanted.
        folder: Where the copies go; it is made.

    Raises:
        OSError: An image can't be read, or its copy not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kept = [k for k in frame_ids if k in images]
    for frame_id in kept:
        write_whole(folder / image_name(frame_id), images[frame_id].read_bytes())
    return len(kept)


def write_colmap(folder: Path, data: RunData, images: Mapping[int, Path]) -> list[Path]:
    """Write ``images/`` and, last, ``sparse/0/*.txt``, each file whole or not at all.

    COLMAP's image id is the frame id + 1 and its point id the landmark id + 1. Points seen in fewer than two
    keyframes are left out: they have no track. ``ERROR`` is the mean reprojection error of the track.

    Args:
        folder: Where the model goes.
        data: The run.
        images: Frame id to file of the kept images.

    Returns:
        The files of the model.
    """
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    frame_ids = exported_frame_ids(data, images)
    rows, point_rows = _tracks(data)
    files = {
        "cameras.txt": _cameras(data),
        "images.txt": _images(data, frame_ids, rows),
        "points3D.txt": _points(data, rows, point_rows),
    }
    num_copied = copy_images(images, frame_ids, folder / "images")
    if num_copied < len(frame_ids):
        logger.warning(
            "%d of %d images were not kept by the run: only its poses and points are whole; "
            "run with --save-images keyframes for images too",
            len(frame_ids) - num_copied,
            len(frame_ids),
        )
    for name, lines in files.items():
        write_whole(model / name, "\n".join(lines) + "\n")
    return [model / name for name in files]


def _tracks(data: RunData) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Observations, sorted by keyframe, of landmarks with a track; and for each the landmark's row."""
    rows = unique_observations(data)
    point_rows = landmark_rows(data)[rows]
    num_seen = np.bincount(point_rows, minlength=len(data.landmark_ids))
    kept = num_seen[point_rows] >= 2
    rows, point_rows = rows[kept], point_rows[kept]
    order = np.argsort(data.observed_keyframe_ids[rows], kind="stable")
    return rows[order], point_rows[order]


def _cameras(data: RunData) -> list[str]:
    c = data.intrinsics
    return [
        "# CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy",
        f"{CAMERA_ID} PINHOLE {c.width} {c.height} {c.fx:.9g} {c.fy:.9g} "
        f"{c.cx + PIXEL_CENTRE:.9g} {c.cy + PIXEL_CENTRE:.9g}",
    ]


def _images(data: RunData, frame_ids: list[int], rows: NDArray[np.int64]) -> list[str]:
    lines = [
        IMAGES_HEADER,
        "# X Y POINT3D_ID ... of the image above",
    ]
    T_cam_world = invert_transform(data.T_world_cam)
    row_of = {frame_id: k for k, frame_id in enumerate(data.frame_ids.tolist())}
    keyframes = data.observed_keyframe_ids[rows]
    for frame_id in frame_ids:
        T = T_cam_world[row_of[frame_id]]
        numbers = " ".join(f"{v:.12g}" for v in (*quat_wxyz_from_rotation(T[:3, :3]), *T[:3, 3]))
        lines.append(f"{frame_id + 1} {numbers} {CAMERA_ID} {image_name(frame_id)}")
        first, last = np.searchsorted(keyframes, [frame_id, frame_id + 1])
        xy = data.observed_xy[rows[first:last]].astype(np.float64) + PIXEL_CENTRE
        ids = data.observed_landmark_ids[rows[first:last]] + 1
        lines.append(
            " ".join(f"{x:.6f} {y:.6f} {k}" for (x, y), k in zip(xy.tolist(), ids.tolist(), strict=True))
        )
    return lines


def _points(data: RunData, rows: NDArray[np.int64], point_rows: NDArray[np.intp]) -> list[str]:
    lines = ["# POINT3D_ID X Y Z R G B ERROR IMAGE_ID POINT2D_IDX ..."]
    keyframes = data.observed_keyframe_ids[rows]
    # The place of an observation within its image: rows are sorted by keyframe.
    place = np.arange(len(rows)) - np.searchsorted(keyframes, keyframes)
    errors_px = reprojection_errors_px(data)[rows]
    order = np.argsort(point_rows, kind="stable")
    starts = np.flatnonzero(np.diff(point_rows[order], prepend=-1))
    for track in np.split(order, starts[1:]) if len(order) else []:
        k = int(point_rows[track[0]])
        error_px = float(np.mean(errors_px[track]))
        x, y, z = data.xyz[k]
        r, g, b = data.rgb[k]
        seen = " ".join(f"{keyframes[o] + 1} {place[o]}" for o in track)
        lines.append(
            f"{data.landmark_ids[k] + 1} {x:.12g} {y:.12g} {z:.12g} {r} {g} {b} "
            f"{error_px if np.isfinite(error_px) else -1:.6g} {seen}"
        )
    return lines
