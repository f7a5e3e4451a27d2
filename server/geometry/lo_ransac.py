"""Relative poses by PoseLib's LO-RANSAC, which knows no confidence."""

from collections.abc import Mapping

import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform
from semcast.server.geometry.pnp import poselib_camera

Array = NDArray[np.float64]

#: Matches that fix a relative pose: fewer that agree prove none.
MIN_INLIERS = 5


def lo_ransac(
    camera: Intrinsics, keypoints0_xy: Array, keypoints1_xy: Array, options: Mapping[str, object]
) -> Array | None:
    """Search for the relative pose most matches agree with; PoseLib refines it at last.

    Args:
        camera: Of both images, without distortion.
        keypoints0_xy: ``(N, 2)`` pixels.
        keypoints1_xy: ``(N, 2)`` pixels, matched row by row.
        options: PoseLib's ``RansacOptions``.

    Returns:
        ``T_cam1_cam0`` with a translation of length 1, or None when nothing was found.
    """
    pinhole = poselib_camera(camera)
    pose, info = poselib.estimate_relative_pose(
        keypoints0_xy, keypoints1_xy, pinhole, pinhole, dict(options), {}
    )
    R, t = np.asarray(pose.R, dtype=np.float64), np.asarray(pose.t, dtype=np.float64)
    length = float(np.linalg.norm(t))
    if info["num_inliers"] < MIN_INLIERS or not (np.isfinite(length) and np.isfinite(R).all()):
        return None
    return make_transform(R, t / length) if length > 0.0 else None
