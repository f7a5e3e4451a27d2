"""Depth reversal: what is near or far when perspective is weak.

A few frames with little perspective fit two structures almost equally well: the true one, and its mirror
image in depth seen from cameras that turn the other way (Necker reversal).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, make_transform, project_to_so3, transform_points
from semcast.server.mapping.bundle_problem import BundleProblem

Array = NDArray[np.float64]

#: Points nearer than this share of the median depth would change side when mirrored.
_MIN_DEPTH_SHARE = 0.2


def mirrored(problem: BundleProblem) -> BundleProblem:
    """Return the same problem started from the mirror image of its structure in depth.

    Every point is mirrored at the plane through the middle of the scene across the line of sight of the first
    camera; every other camera turns about the middle of the scene the other way. Under weak perspective the
    images stay the same.
    """
    T_world_first = problem.T_world_cam[0]
    T_first_world = invert_transform(T_world_first)
    xyz = transform_points(T_first_world, problem.xyz)
    middle = np.median(xyz, axis=0)
    depth = float(np.linalg.norm(middle))
    flip = _across(middle)
    turned = (xyz - middle) @ flip + middle
    along = middle / max(depth, 1e-12)
    too_near = np.maximum(0.0, _MIN_DEPTH_SHARE * depth - turned @ along)
    turned = turned + too_near[:, None] * along
    poses = []
    for T_world_cam in problem.T_world_cam:
        T_cam_first = invert_transform(T_world_cam) @ T_world_first
        middle_cam = T_cam_first[:3, :3] @ middle + T_cam_first[:3, 3]
        R = project_to_so3(_across(middle_cam) @ T_cam_first[:3, :3] @ flip)
        poses.append(T_world_first @ invert_transform(make_transform(R, middle_cam - R @ middle)))
    return replace(
        problem,
        T_world_cam=np.stack(poses),
        xyz=transform_points(T_world_first, turned),
    )


def _across(direction: Array) -> Array:
    """Mirror at the plane across a direction, ``(3, 3)``."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    return np.asarray(np.eye(3) - 2.0 * np.outer(unit, unit))
