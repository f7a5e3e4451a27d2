"""The second structure of a flat scene: two images of a plane fit another pose before another plane as well.

A homography comes from two pairs of pose and plane, and often both lie in front of the cameras
(Longuet-Higgins 1986). While a camera moves on evenly, further views tell them apart only slowly: to first
order every image of the one motion is an image of the other. So at the start of a map the other pair is
adjusted as well.
"""

from dataclasses import replace

import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.common.geometry import (
    interpolate_pose,
    invert_transform,
    make_transform,
    project_to_so3,
    transform_points,
)
from semcast.server.geometry.pnp import refine_pose
from semcast.server.mapping.bundle_problem import BundleProblem

Array = NDArray[np.float64]

#: A scene may be flat where a homography explains this share of the points. Generous, since a twin that does
#: not fit is found out by its cost.
_MIN_SHARE = 0.5
#: Standard deviations within which a point is explained.
_CUT_SIGMAS = 4.0
#: Points by which a plane, or a view of it, is told at least.
_MIN_POINTS = 12
#: Share of the points that must lie in front of both cameras: noise tilts a plane seen at a low angle.
_MIN_IN_FRONT = 0.75
#: Ways of the camera nearer to each other than this are the present structure, not another.
_SAME_WAY_DEG = 5.0


def twin(problem: BundleProblem) -> BundleProblem | None:
    """Return the same problem started from the other pose and plane, None where there is no other.

    Args:
        problem: At least two views of a new map. Points are taken where the first and the last view see them.
    """
    last = len(problem.T_world_cam) - 1
    of_first, of_last = problem.view == 0, problem.view == last
    _, row0, row1 = np.intersect1d(problem.point[of_first], problem.point[of_last], return_indices=True)
    if len(row0) < _MIN_POINTS:
        return None
    xy0, xy1 = problem.xy[of_first][row0], problem.xy[of_last][row1]
    reach_px = _CUT_SIGMAS * float(np.median(problem.sigma_px))
    H, info = poselib.estimate_homography(xy0, xy1, {"max_reproj_error": reach_px, "seed": 0}, {})
    if info["num_inliers"] < max(_MIN_POINTS, _MIN_SHARE * len(row0)) or not np.isfinite(H).all():
        return None
    flat = np.asarray(info["inliers"], dtype=bool)
    camera, K = problem.camera, problem.camera.K
    found = _other_pose(np.linalg.inv(K) @ np.asarray(H) @ K, problem, camera.unproject(xy0[flat]))
    if found is None:
        return None
    R_last_first, t_last_first, normal = found
    return _on_plane(problem, R_last_first, t_last_first, normal)


def _other_pose(H: Array, problem: BundleProblem, rays: Array) -> tuple[Array, Array, Array] | None:
    """Rotation, translation (plane at distance 1) and normal of the pair that is not the present one."""
    poses, normals = poselib.motion_from_homography(H)
    T_now = invert_transform(problem.T_world_cam[-1]) @ problem.T_world_cam[0]
    way_now = -T_now[:3, :3].T @ T_now[:3, 3]
    found, furthest = None, np.cos(np.radians(_SAME_WAY_DEG)) * np.linalg.norm(way_now)
    for pose, n in zip(poses, normals, strict=True):
        t, normal = np.asarray(pose.t), np.asarray(n)
        length = float(np.linalg.norm(t))
        if not (np.isfinite(pose.R).all() and np.isfinite(normal).all() and 1e-9 < length < np.inf):
            continue
        R = project_to_so3(np.asarray(pose.R))
        height = rays @ normal
        seen = rays @ R.T + height[:, None] * t  # times the depth, which has the sign of the height
        in_front = (height > 0.0) & (seen[:, 2] > 0.0)
        alike = float(way_now @ (-R.T @ t)) / length
        if in_front.mean() >= _MIN_IN_FRONT and alike < furthest:
            found, furthest = (R, t, normal), alike
    return found


def _on_plane(
    problem: BundleProblem, R_last_first: Array, t_last_first: Array, normal: Array
) -> BundleProblem:
    """Put all points on the plane and the views between where those ask for them."""
    T_world_first = problem.T_world_cam[0]
    baseline = np.linalg.norm((invert_transform(T_world_first) @ problem.T_world_cam[-1])[:3, 3])
    distance = float(baseline / np.linalg.norm(t_last_first))
    T_last = invert_transform(make_transform(R_last_first, distance * t_last_first))
    num_views = len(problem.T_world_cam)
    poses = [np.eye(4)]
    # The plane is n^T X = distance in the first camera's frame; a ray meets it from any pose.
    xyz = np.full((len(problem.xyz), 3), np.nan)
    _place(xyz, problem, 0, np.eye(4), normal, distance)
    for k in range(1, num_views):
        T = interpolate_pose(np.eye(4), T_last, k / (num_views - 1))
        if k < num_views - 1:
            rows = np.flatnonzero((problem.view == k) & np.isfinite(xyz[problem.point, 0]))
            if len(rows) >= _MIN_POINTS:
                points, sigma = xyz[problem.point[rows]], problem.sigma_px[rows]
                gate = np.full(len(rows), 10.0 * float(np.median(problem.sigma_px)))
                estimate = refine_pose(
                    problem.camera, invert_transform(T), points, problem.xy[rows], sigma, gate
                )
                T = invert_transform(estimate.T_cam_world)
        poses.append(T)
        _place(xyz, problem, k, T, normal, distance)
    xyz = np.where(np.isfinite(xyz), xyz, normal * distance)
    return replace(
        problem,
        T_world_cam=T_world_first @ np.stack(poses),
        xyz=transform_points(T_world_first, xyz),
    )


def _place(
    xyz: Array,
    problem: BundleProblem,
    view: int,
    T_first_cam: Array,
    normal: Array,
    distance: float,
) -> None:
    """Give the points a view sees, and no view before it, their place on the plane."""
    rows = np.flatnonzero((problem.view == view) & ~np.isfinite(xyz[problem.point, 0]))
    rays = problem.camera.unproject(problem.xy[rows]) @ T_first_cam[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (distance - T_first_cam[:3, 3] @ normal) / (rays @ normal)
    good = np.isfinite(depth) & (depth > 0.0)
    xyz[problem.point[rows[good]]] = T_first_cam[:3, 3] + depth[good, None] * rays[good]
