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

from semcast.common.geometry import (
    angle_between_deg,
    angles_between_deg,
    invert_transform,
    rotation_angle_deg,
)
from semcast.server.geometry.edges import whitened
from semcast.server.mapping.bas_relief import nearer
from semcast.server.mapping.bundle import optimise, residuals_px
from semcast.server.mapping.bundle_problem import BundleProblem
from semcast.server.mapping.depth_reversal import mirrored
from semcast.server.mapping.planar_ambiguity import twin

Array = NDArray[np.float64]

#: Errors are cut off here, in standard deviations: an observation further off belongs to neither structure.
_CUT_SIGMAS = 3.0
#: How many times the better structure the worse one must cost, in one attempt or as the product over several.
#: Chosen on starts in synthetic rooms and over poor links, like the next one.
_CLEAR_RATIO = 1.4
#: The same where the cameras of both go the same way: a relief that is too deep, with some of its points on
#: the wrong side, shares most of them with the true one.
_CLEAR_RATIO_SAME_WAY = 1.2
#: Two structures are the same where directions to the last camera are nearer to each other than this,
_SAME_WAY_DEG = 20.0
#: and its rotations nearer than this share of the parallax: a relief three times too deep needs a third of
#: the turn.
_SAME_TURN_SHARE = 0.4
#: How many times nearer the scene may be than it is found.
_NEARER = (3.0, 1.0 / 3.0)
#: A structure that costs this many times the cheapest one needs no search for others next to it.
_HOPELESS_RATIO = np.e


@dataclass(frozen=True)
class Structure:
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


def adjusted(problem: BundleProblem) -> Structure:
    """Adjust one of the structures to all observations."""
    result = optimise(problem)
    # All observations anew: those that could not be used at the start count as well.
    cost = cost_of(replace(problem, T_world_cam=result.T_world_cam, xyz=result.xyz))
    return Structure(result.T_world_cam, result.xyz, cost, result.ok)


def cost_of(problem: BundleProblem) -> float:
    """Sum of squared residuals in standard deviations, each cut off, of a structure as it is."""
    residual, _ = residuals_px(problem, problem.T_world_cam, problem.xyz)
    error = whitened(problem.edge, np.nan_to_num(residual, nan=1e6))
    size = np.linalg.norm(error, axis=1) / problem.sigma_px
    return float((np.minimum(size, _CUT_SIGMAS) ** 2).sum())


def decide(
    problem: BundleProblem, carried: Sequence[tuple[BundleProblem, float]] = (), *, at_last: bool = False
) -> tuple[Structure | None, list[Structure]]:
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
    # What fits worse than the start is on the way to it, and no structure of its own.
    along = [adjusted(nearer(after, factor)) for factor in _NEARER]
    found += [structure for structure in along if structure.cost < start.cost]
    found += _mirrored_again(problem, found)
    for begun, doubt in carried:
        found.append(replace(adjusted(begun), doubt=doubt))
    structures = _weighed(found, len(carried))
    best, rest = structures[0], structures[1:]
    if at_last:
        return best, structures
    # An adjustment that failed says nothing against the structure it began with.
    is_sure = start.ok and best.ok and all(structure.ok for structure in rest[:1])
    is_clear = all(structure.doubt - best.doubt >= _clear_doubt(best, structure) for structure in rest)
    return (best if is_sure and is_clear else None), structures


def _clear_doubt(best: Structure, other: Structure) -> float:
    """How much more doubt a structure must have than the best one."""
    same_way = _way_between_deg(best, other) < _SAME_WAY_DEG
    return float(np.log(_CLEAR_RATIO_SAME_WAY if same_way else _CLEAR_RATIO))


def _mirrored_again(problem: BundleProblem, found: list[Structure]) -> list[Structure]:
    """Mirror images of the structures that were found beside the start.

    A start may be a mixture, too far away and with some of its points on the wrong side: its mirror image
    then leads to that of the true structure, and only the image of that to the true one.
    """
    lowest = min(structure.cost for structure in found)
    told_apart, again = found[:1], []
    for structure in found[1:]:
        if any(_is_same(structure, other) for other in told_apart):
            continue
        told_apart.append(structure)
        if structure.cost < _HOPELESS_RATIO * lowest:
            again.append(
                adjusted(mirrored(replace(problem, T_world_cam=structure.T_world_cam, xyz=structure.xyz)))
            )
    return again


def _weighed(found: list[Structure], num_carried: int) -> list[Structure]:
    """Structures that differ, each as its cheapest copy, with their doubt after this attempt, least first.

    Args:
        found: Adjusted.
        num_carried: So many of the last ones have a doubt from before.
    """
    by_cost = sorted(range(len(found)), key=lambda k: found[k].cost)
    lowest = max(found[by_cost[0]].cost, 1e-9)
    structures: list[Structure] = []
    doubts: list[list[float]] = []
    for k in by_cost:
        structure = found[k]
        same = next((row for row, other in enumerate(structures) if _is_same(structure, other)), None)
        if same is None:
            structures.append(structure)
            doubts.append([])
            same = len(structures) - 1
        if k >= len(found) - num_carried:
            doubts[same].append(structure.doubt)
    # What is found for the first time is as good as the best one until now, no better.
    new = min((doubt for before in doubts for doubt in before), default=0.0)
    weighed = [
        replace(structure, doubt=min(before, default=new) + float(np.log(max(structure.cost, 1e-9) / lowest)))
        for structure, before in zip(structures, doubts, strict=True)
    ]
    return sorted(weighed, key=lambda structure: structure.doubt)


def _is_same(a: Structure, b: Structure) -> bool:
    """Whether both adjustments ended in the same structure: the last cameras went and turned the same way."""
    turn_deg = rotation_angle_deg(_last(a)[:3, :3].T @ _last(b)[:3, :3])
    same_turn = turn_deg < _SAME_TURN_SHARE * max(_parallax_deg(a), _parallax_deg(b))
    return same_turn and _way_between_deg(a, b) < _SAME_WAY_DEG


def _way_between_deg(a: Structure, b: Structure) -> float:
    return angle_between_deg(_last(a)[:3, 3], _last(b)[:3, 3])


def _last(structure: Structure) -> Array:
    """The last camera in the frame of the first."""
    return np.asarray(invert_transform(structure.T_world_cam[0]) @ structure.T_world_cam[-1])


def _parallax_deg(structure: Structure) -> float:
    """Median angle between the rays from the first and the last camera to the points."""
    first, last = (structure.xyz - structure.T_world_cam[k][:3, 3] for k in (0, -1))
    return float(np.median(angles_between_deg(first, last)))
