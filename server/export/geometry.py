"""What follows from the arrays of a finished run alone: whose its observations are, and their errors."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.common.run_folder import RunData


def unique_observations(data: RunData) -> NDArray[np.int64]:
    """Return rows of observations, the first of each (landmark, keyframe), in their order."""
    pairs = np.stack([data.observed_landmark_ids, data.observed_keyframe_ids], axis=1)
    _, first = np.unique(pairs, axis=0, return_index=True)
    return np.sort(first)


def landmark_rows(data: RunData) -> NDArray[np.intp]:
    """Return the row of the landmark of each observation, ``(M,)``."""
    sorter = np.argsort(data.landmark_ids)
    return np.asarray(sorter[np.searchsorted(data.landmark_ids, data.observed_landmark_ids, sorter=sorter)])


def reprojection_errors_px(data: RunData) -> NDArray[np.float64]:
    """Return ``(M,)`` distances in pixels between observed and projected landmarks.

    NaN where a landmark is at or behind its keyframe's camera plane.
    """
    frame_row = np.searchsorted(data.frame_ids, data.observed_keyframe_ids)
    T_cam_world = invert_transform(data.T_world_cam)[frame_row]
    points_cam = (T_cam_world[:, :3, :3] @ data.xyz[landmark_rows(data)][:, :, None])[..., 0] + T_cam_world[
        :, :3, 3
    ]
    projected_xy = data.intrinsics.project(points_cam)
    return np.asarray(np.linalg.norm(projected_xy - data.observed_xy, axis=1))
