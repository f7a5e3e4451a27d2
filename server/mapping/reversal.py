"""Depth reversal at the start of a map: what is near or far when perspective is weak.

A few frames with little perspective fit two structures almost equally well: the true one, and its mirror
image in depth seen from cameras that turn the other way (Necker reversal). Noise then decides which of the
two a relative pose comes out as, and a map that begins mirrored never recovers: it drifts to a wrong path
with all its frames posed. So the mirror image of every start is adjusted as well, to the same observations,
and a start is only believed when one of the two fits clearly better.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, make_transform, project_to_so3
from semcast.server.mapping.bundle import optimise, residuals_px
from semcast.server.mapping.bundle_problem import BundleProblem

Array = NDArray[np.float64]

#: An observation further off than this counts as this: it belongs to neither structure.
_CUT_SIGMAS = 3.0
#: Points nearer than this share of the median depth would change side when mirrored.
_MIN_DEPTH_SHARE = 0.2
#: The worse structure must cost so many times the better one. Chosen on starts over poor links, where wrong
#: decisions had ratios below this and most right ones clearly more.
_CLEAR_RATIO = 1.3
#: Directions of the last camera nearer to each other than this are one structure.
_SAME_WAY_DEG = 20.0


@dataclass(frozen=True)
class Side:
    """One of the two structures after adjustment.

    Attributes:
        T_world_cam: ``(K, 4, 4)``.
        xyz: ``(P, 3)``.
        cost: Sum of squared residuals in standard deviations, each cut off.
        ok: False where the adjustment failed and all is as it was.
    """

    T_world_cam: Array
    xyz: Array
    cost: float
    ok: bool


def mirrored(problem: BundleProblem) -> BundleProblem:
    """Return the same problem started from the mirror image of its structure in depth.

    Every point is mirrored at the plane through the middle of the scene across the line of sight of the first
    camera; every other camera turns about the middle of the scene the other way. Under weak perspective the
    images stay the same.
    """
    T_world_first = problem.T_world_cam[0]
    T_first_world = invert_transform(T_world_first)
    xyz = problem.xyz @ T_first_world[:3, :3].T + T_first_world[:3, 3]
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
        xyz=turned @ T_world_first[:3, :3].T + T_world_first[:3, 3],
    )


def _across(direction: Array) -> Array:
    """Mirror at the plane across a direction, ``(3, 3)``."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    return np.asarray(np.eye(3) - 2.0 * np.outer(unit, unit))


def adjusted(problem: BundleProblem) -> Side:
    """Adjust one of the two structures to all observations."""
    result = optimise(problem)
    # All observations anew: those that could not be used at the start count as well.
    residual, _ = residuals_px(problem, result.T_world_cam, result.xyz)
    size = np.linalg.norm(np.nan_to_num(residual, nan=1e6), axis=1) / problem.sigma_px
    return Side(result.T_world_cam, result.xyz, float((np.minimum(size, _CUT_SIGMAS) ** 2).sum()), result.ok)


def decide(problem: BundleProblem, *, at_last: bool = False) -> Side | None:
    """Return the structure the observations speak for, None while they speak for both.

    Args:
        problem: Some views of a new map with all observations, also those that fit its poses badly.
        at_last: Take the better one in any case.
    """
    problem = replace(problem, with_covariance=False)
    start = adjusted(problem)
    if not start.ok and not at_last:
        return None  # an adjustment that failed says nothing against the structure it began with
    # Neither mirror image leads to its own minimum every time: that of a rough start where the start is the
    # wrong structure in part, that of the adjusted one where the adjustment has stretched it.
    after = replace(problem, T_world_cam=start.T_world_cam, xyz=start.xyz)
    mirror = min((adjusted(mirrored(p)) for p in (problem, after)), key=lambda side: side.cost)
    better, worse = sorted((start, mirror), key=lambda side: side.cost)
    if at_last or worse.cost >= _CLEAR_RATIO * better.cost or _is_same(better, worse):
        return better
    return None


def _is_same(a: Side, b: Side) -> bool:
    """Whether both adjustments ended in the same structure: the last cameras went the same way."""
    ways = [(invert_transform(s.T_world_cam[0]) @ s.T_world_cam[-1])[:3, 3] for s in (a, b)]
    unit = [way / max(float(np.linalg.norm(way)), 1e-12) for way in ways]
    return bool(unit[0] @ unit[1] > np.cos(np.radians(_SAME_WAY_DEG)))
