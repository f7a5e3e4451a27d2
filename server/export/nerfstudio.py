"""``transforms.json`` as nerfstudio and gsplat read it: camera-to-world poses in OpenGL axes, points as PLY.

nerfstudio's camera looks along -z with y up, and its world has z up
(https://docs.nerf.studio/quickstart/data_conventions.html). Its pixel centres are at half integers.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from semcast.common.errors import SourceError
from semcast.common.geometry import T_opencv_opengl, transform_points
from semcast.common.run_folder import RunData, image_name
from semcast.common.whole_file import write_whole
from semcast.server.export.colmap import PIXEL_CENTRE, copy_images
from semcast.server.export.outputs import write_ply

#: Other programs call theirs otherwise (``sparse_pc.ply``), so by this an export is known.
POINTS_NAME = "points3D.ply"
#: Our world (first camera: y down, z forward) in a world with z up: x stays, forward becomes y.
T_up_world = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def write_nerfstudio(
    folder: Path, data: RunData, images: Mapping[int, Path], frame: str | None = None
) -> list[Path]:
    """Write ``images/`` of all posed frames whose image was kept, ``points3D.ply`` and ``transforms.json``.

    Each file is whole or not there, and ``transforms.json``, which names the others, comes last.
    Poses and points are in the world with z up; ``applied_transform`` says how it came from ours.

    Args:
        folder: Where to write.
        data: The run.
        images: Frame id to file of the kept images.
        frame: What axes and unit of ``data`` are, where these are not the map's own: they stay.

    Raises:
        SourceError: The run kept no images.
    """
    frame_ids = [k for k in data.frame_ids.tolist() if k in images]
    if not frame_ids:
        raise SourceError("the run kept no images, and nerfstudio needs them; run again with --save-images")
    folder.mkdir(parents=True, exist_ok=True)
    copy_images(images, frame_ids, folder / "images")
    c = data.intrinsics
    T_out_world = T_up_world if frame is None else np.eye(4)
    row_of = {frame_id: k for k, frame_id in enumerate(data.frame_ids.tolist())}
    frames = []
    for frame_id in frame_ids:
        T_out_opengl = T_out_world @ data.T_world_cam[row_of[frame_id]] @ T_opencv_opengl
        frames.append(
            {"file_path": f"images/{image_name(frame_id)}", "transform_matrix": T_out_opengl.tolist()}
        )
    content = {
        "camera_model": "OPENCV",
        "w": c.width,
        "h": c.height,
        "fl_x": c.fx,
        "fl_y": c.fy,
        "cx": c.cx + PIXEL_CENTRE,
        "cy": c.cy + PIXEL_CENTRE,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "applied_transform": T_out_world[:3].tolist(),
        "ply_file_path": POINTS_NAME,
        "frames": frames,
    }
    transforms, points = folder / "transforms.json", folder / POINTS_NAME
    write_ply(
        points,
        transform_points(T_out_world, data.xyz),
        data.rgb,
        data.confidence,
        frame=frame or "z up, y forward of the first camera; map units",
    )
    write_whole(transforms, json.dumps(content, indent=1) + "\n")
    return [transforms, points]
