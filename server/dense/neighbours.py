"""Which views tell the depth of a keyframe, between which depths it is sought, and how many confirm it."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, rotation_angle_deg
from semcast.server.dense.depth_map import DepthProblem
from semcast.server.dense.plane_sweep import Neighbour
from semcast.server.dense.view import View

Array = NDArray[np.float64]

#: Neighbours on either side, each so much further away than the one before, in shares of the median depth.
NUM_NEIGHBOURS = 2
_BASELINE = 0.04
#: Neighbours whose view is turned by more see too little of the same, and that too differently.
_MAX_TURN_DEG = 40.0
#: Percentile of the depths of a keyframe's landmarks, and factor on it, at which the search for depth begins
_NEAR = (2.0, 1.0 / 1.3)
#: and ends.
_FAR = (98.0, 1.5)
#: Keyframes with fewer landmarks tell no range of depths.
_MIN_LANDMARKS = 10
#: Keyframes on either side whose depth may confirm one; two of them must where there are three or more.
NUM_CONFIRMING = 3
#: Keyframes before, whose points are not added once more.
NUM_COVERING = 4


class DepthRange(NamedTuple):
    """Between which depths there is something, map units.

    Attributes:
        nearest: Least depth that is tried.
        median: Of the landmarks.
        farthest: Greatest depth that is tried.
    """

    nearest: float
    median: float
    farthest: float


def depth_range(depth: Array) -> DepthRange | None:
    """Tell where depth is sought from the depths ``(N,)`` of a keyframe's landmarks; None with few."""
    if len(depth) < _MIN_LANDMARKS:
        return None
    near, far = (float(np.percentile(depth, share)) * factor for share, factor in (_NEAR, _FAR))
    return DepthRange(near, float(np.median(depth)), far)


def choose_neighbours(
    T_world_ref: Array, median_depth: float, side: Iterable[tuple[View, Array]]
) -> list[Neighbour]:
    """Choose views on one side of a keyframe.

    Args:
        T_world_ref: ``(4, 4)`` pose of the keyframe.
        median_depth: Of its landmarks, map units.
        side: Views and their poses ``(4, 4)``, from the nearest in time on.
    """
    found: list[Neighbour] = []
    for view, T_world_nbr in side:
        T_nbr_ref = invert_transform(T_world_nbr) @ T_world_ref
        if np.linalg.norm(T_nbr_ref[:3, 3]) < _BASELINE * median_depth * (len(found) + 1):
            continue
        if rotation_angle_deg(T_nbr_ref[:3, :3]) > _MAX_TURN_DEG:
            break
        found.append(Neighbour(view, T_nbr_ref))
        if len(found) == NUM_NEIGHBOURS:
            break
    return found


def depth_problem(
    reference: View, T_world_ref: Array, sought: DepthRange, sides: Sequence[Iterable[tuple[View, Array]]]
) -> DepthProblem | None:
    """Ask for the depth of a keyframe; None where no view tells it.

    Args:
        reference: The keyframe's view.
        T_world_ref: ``(4, 4)`` its pose.
        sought: Between which depths.
        sides: Views before it and after it, each as ``choose_neighbours`` takes them.
    """
    groups = [choose_neighbours(T_world_ref, sought.median, side) for side in sides]
    groups = [group for group in groups if group]
    return DepthProblem(reference, groups, sought.nearest, sought.farthest) if groups else None


def confirming(frame_ids: Iterable[int], frame_id: int) -> list[int]:
    """Of some keyframes those whose depth may confirm another's: the next ones before and after it."""
    order = sorted(frame_ids)
    before, after = [k for k in order if k < frame_id], [k for k in order if k > frame_id]
    return before[-NUM_CONFIRMING:] + after[:NUM_CONFIRMING]


def num_to_confirm(num_others: int) -> int:
    """How many of the depths of other keyframes have to agree with one."""
    return 2 if num_others > 2 else 1
