"""Relative poses that two images may have: what searches find, and those near pure turning and of a plane."""

from collections.abc import Mapping

import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform, project_to_so3
from semcast.server.geometry.epipolar import fit_rotation, refine_relative_pose
from semcast.server.geometry.lo_ransac import lo_ransac
from semcast.server.geometry.ransac import in_front

Array = NDArray[np.float64]

#: Fewer tell no relative pose.
MIN_MATCHES = 8
#: Thresholds of the searches, in units of the one that is asked for.
_THRESHOLD_FACTORS = (1.0, 2.0)
#: Where more than this share of the matches agree, a search among these alone is the first one over again.
_NEARLY_ALL = 0.9
#: Matches by which the motions near pure turning are sought, at most.
_MAX_TURNING_MATCHES = 100
#: Steps of each of those searches.
_TURNING_STEPS = 6


def searched(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    kept: NDArray[np.intp],
    confidence: Array | None,
    threshold_px: float,
    how: Mapping[str, int],
) -> list[Array | None]:
    """What the searches find, at two thresholds each."""
    return [
        search(camera, xy0[rows], xy1[rows], factor * threshold_px, in_order=in_order, **how)
        for factor in _THRESHOLD_FACTORS
        for rows, in_order in _orders_of_drawing(len(xy0), kept, confidence)
    ]


def _orders_of_drawing(
    count: int, kept: NDArray[np.intp], confidence: Array | None
) -> list[tuple[NDArray[np.intp], bool]]:
    """Matches of each search, and whether it draws the first of them first."""
    orders: list[tuple[NDArray[np.intp], bool]] = [(np.arange(count), False)]
    if len(kept) < _NEARLY_ALL * count:
        orders.append((kept, False))
    if confidence is not None:
        orders.append((kept[np.argsort(-confidence[kept], kind="stable")], True))
    return orders


def search(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    threshold_px: float,
    *,
    in_order: bool,
    seed: int,
    max_iterations: int,
    min_iterations: int,
) -> Array | None:
    """PoseLib's LO-RANSAC; in order, it draws the first matches first."""
    options = {
        "max_epipolar_error": threshold_px,
        "success_prob": 0.9999,
        "max_iterations": max_iterations,
        "min_iterations": min_iterations,
        "seed": seed,
        "progressive_sampling": in_order,
    }
    found = lo_ransac(camera, xy0, xy1, options)
    return None if found is None else make_transform(project_to_so3(found[:3, :3]), found[:3, 3])


def near_turning(camera: Intrinsics, xy0: Array, xy1: Array, threshold_px: float) -> list[Array]:
    """Poses near the turn that explains the matches best, with a translation from each axis on, both ways."""
    rows = np.linspace(0, len(xy0) - 1, min(len(xy0), _MAX_TURNING_MATCHES)).astype(np.intp)
    xy0, xy1 = xy0[rows], xy1[rows]
    R = fit_rotation(camera, xy0, xy1)
    sigma_px = np.full(len(rows), 2.0 * threshold_px)
    return [
        refine_relative_pose(camera, make_transform(R, axis), xy0, xy1, sigma_px, iterations=_TURNING_STEPS)
        for axis in (*np.eye(3), *-np.eye(3))
    ]


def from_plane(
    camera: Intrinsics, xy0: Array, xy1: Array, threshold_px: float, seed: int
) -> list[Array | None]:
    """Poses of the plane most matches lie on; none where no plane stands out."""
    options = {"max_reproj_error": 2.0 * threshold_px, "max_iterations": 500, "seed": seed}
    H, info = poselib.estimate_homography(xy0, xy1, options, {})
    if info["num_inliers"] < max(MIN_MATCHES, 0.5 * len(xy0)) or not np.isfinite(H).all():
        return []
    on_plane = np.asarray(info["inliers"], dtype=bool)
    K = camera.K
    poses, _ = poselib.motion_from_homography(np.linalg.inv(K) @ np.asarray(H) @ K)
    starts: list[Array] = []
    for pose in poses:
        t = np.asarray(pose.t, dtype=np.float64)
        length = float(np.linalg.norm(t))
        if not np.isfinite(length) or length < 1e-9 or not np.isfinite(pose.R).all():
            continue
        T = make_transform(project_to_so3(pose.R), t / length)
        T = in_front(camera, T, xy0[on_plane], xy1[on_plane])
        # Each pose comes twice, with the plane before and behind the camera.
        if not any(np.allclose(T, other, atol=1e-6) for other in starts):
            starts.append(T)
    sigma_px = np.full(len(xy0), 0.5 * threshold_px)
    return [refine_relative_pose(camera, T, xy0, xy1, sigma_px) for T in starts]
