"""Which structure a map begins with, where the first views fit more than one.

Perspective that is weak leaves the mirror image in depth, and a flat scene leaves a second pair of pose and
plane. Noise then decides which one a relative pose comes out as, and a map that begins with the wrong one
never recovers: it drifts to a wrong path with all its frames posed. So the others are adjusted as well, to
the same observations, and a start is only believed when one of them fits clearly better: at once, or a
little each time over several attempts. Costs vary with the noise of the views chosen, and the wrong structure
is ahead now and then, but not time after time.
"""

from collections.abc import Sequence
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
#: The worse structure must cost so many times the better one, in one attempt or as the product over several.
#: Chosen on starts in synthetic rooms and over poor links.
_CLEAR_RATIO = 1.4
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
        doubt: Logarithm of how many times the cheapest one's cost it has, summed over the attempts so far.
            One found later begins with the least doubt of the others.
    """

    T_world_cam: Array
    xyz: Array
    cost: float
    ok: bool
    doubt: float = 0.0


def adjusted(problem: BundleProblem) -> Side:
    """Adjust one of the structures to all observations."""
    result = optimise(problem)
    # All observations anew: those that could not be used at the start count as well.
    residual, _ = residuals_px(problem, result.T_world_cam, result.xyz)
    size = np.linalg.norm(np.nan_to_num(residual, nan=1e6), axis=1) / problem.sigma_px
    return Side(result.T_world_cam, result.xyz, float((np.minimum(size, _CUT_SIGMAS) ** 2).sum()), result.ok)


def decide(
    problem: BundleProblem, carried: Sequence[tuple[BundleProblem, float]] = (), *, at_last: bool = False
) -> tuple[Side | None, list[Side]]:
    """Find the structure the observations speak for.

    Args:
        problem: Some views of a new map with all observations, also those that fit its poses badly.
        carried: The same begun from structures that earlier views fitted, each with its doubt until now.
        at_last: Take the better one in any case.

    Returns:
        The structure, None while the observations speak for several; and all that differ, best first.
    """
    start = adjusted(problem)
    # Neither mirror image leads to its own minimum every time: that of a rough start where the start is the
    # wrong structure in part, that of the adjusted one where the adjustment has stretched it.
    after = replace(problem, T_world_cam=start.T_world_cam, xyz=start.xyz)
    others = [mirrored(problem), mirrored(after)]
    flat = twin(after)
    if flat is not None:
        others.append(flat)
    found = [start, *(adjusted(p) for p in others)]
    for begun, doubt in carried:
        found.append(replace(adjusted(begun), doubt=doubt))
    sides = _weighed(found, len(carried))
    best, rest = sides[0], sides[1:]
    if at_last:
        return best, sides
    # An adjustment that failed says nothing against the structure it began with.
    is_sure = start.ok and best.ok and all(side.ok for side in rest[:1])
    is_clear = not rest or rest[0].doubt - best.doubt >= np.log(_CLEAR_RATIO)
    return (best if is_sure and is_clear else None), sides


def _weighed(found: list[Side], num_carried: int) -> list[Side]:
    """Structures that differ, each as its cheapest copy, with their doubt after this attempt, least first.

    Args:
        found: Adjusted.
        num_carried: So many of the last ones have a doubt from before.
    """
    by_cost = sorted(range(len(found)), key=lambda k: found[k].cost)
    lowest = max(found[by_cost[0]].cost, 1e-9)
    sides: list[Side] = []
    doubts: list[list[float]] = []
    for k in by_cost:
        side = found[k]
        same = next((row for row, other in enumerate(sides) if _is_same(side, other)), None)
        if same is None:
            sides.append(side)
            doubts.append([])
            same = len(sides) - 1
        if k >= len(found) - num_carried:
            doubts[same].append(side.doubt)
    # What is found for the first time is as good as the best one until now, no better.
    new = min((doubt for before in doubts for doubt in before), default=0.0)
    weighed = [
        replace(side, doubt=min(before, default=new) + float(np.log(max(side.cost, 1e-9) / lowest)))
        for side, before in zip(sides, doubts, strict=True)
    ]
    return sorted(weighed, key=lambda side: side.doubt)


def _is_same(a: Side, b: Side) -> bool:
    """Whether both adjustments ended in the same structure: the last cameras went the same way."""
    ways = [(invert_transform(s.T_world_cam[0]) @ s.T_world_cam[-1])[:3, 3] for s in (a, b)]
    unit = [way / max(float(np.linalg.norm(way)), 1e-12) for way in ways]
    return bool(unit[0] @ unit[1] > np.cos(np.radians(_SAME_WAY_DEG)))
