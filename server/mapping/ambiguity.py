"""Which structure a map begins with, where the first views fit more than one.

Perspective that is weak leaves the mirror image in depth, and a flat scene leaves a second pair of pose and
plane. Noise then decides which one a relative pose comes out as, and a map that begins with the wrong one
never recovers: it drifts to a wrong path with all its frames posed. So the others are adjusted as well, to
the same observations, and a start is only believed when one of them fits clearly better.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.mapping.bundle import optimise, residuals_px
from semcast.server.mapping.bundle_problem import BundleProblem
from semcast.server.mapping.planar import twin
from semcast.server.mapping.reversal import mirrored

Array = NDArray[np.float64]

#: An observation further off than this counts as this: it belongs to neither structure.
_CUT_SIGMAS = 3.0
#: The worse structure must cost so many times the better one. Chosen on starts over poor links, where wrong
#: decisions had ratios below this and most right ones clearly more.
_CLEAR_RATIO = 1.3
#: Directions of the last camera nearer to each other than this are one structure.
_SAME_WAY_DEG = 20.0


@dataclass(frozen=True)
class Side:
    """One of the structures after adjustment.

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


def adjusted(problem: BundleProblem) -> Side:
    """Adjust one of the structures to all observations."""
    result = optimise(problem)
    # All observations anew: those that could not be used at the start count as well.
    residual, _ = residuals_px(problem, result.T_world_cam, result.xyz)
    size = np.linalg.norm(np.nan_to_num(residual, nan=1e6), axis=1) / problem.sigma_px
    return Side(result.T_world_cam, result.xyz, float((np.minimum(size, _CUT_SIGMAS) ** 2).sum()), result.ok)


def decide(problem: BundleProblem, *, at_last: bool = False) -> Side | None:
    """Return the structure the observations speak for, None while they speak for several.

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
    others = [mirrored(problem), mirrored(after)]
    flat = twin(after)
    if flat is not None:
        others.append(flat)
    sides = sorted((start, *(adjusted(p) for p in others)), key=lambda side: side.cost)
    best, rest = sides[0], [side for side in sides[1:] if not _is_same(sides[0], side)]
    if at_last:
        return best
    is_clear = not rest or (rest[0].ok and rest[0].cost >= _CLEAR_RATIO * best.cost)
    return best if best.ok and is_clear else None


def _is_same(a: Side, b: Side) -> bool:
    """Whether both adjustments ended in the same structure: the last cameras went the same way."""
    ways = [(invert_transform(s.T_world_cam[0]) @ s.T_world_cam[-1])[:3, 3] for s in (a, b)]
    unit = [way / max(float(np.linalg.norm(way)), 1e-12) for way in ways]
    return bool(unit[0] @ unit[1] > np.cos(np.radians(_SAME_WAY_DEG)))
