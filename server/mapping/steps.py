"""Relative poses between consecutive keyframes, as tracking found them, with the drift they may have.

Where keyframes between two were thinned out, and the landmarks with them, the relative pose of the two is all
that is left of what was seen there.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from semcast.common.geometry import invert_transform, rotation_angle_deg
from semcast.server.mapping.pose_graph import PoseConstraint
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.thinning import is_gap
from semcast.server.mapping.world_map import Keyframe, WorldMap

#: Standard deviations of the drift from one keyframe to the next. Rotation, in radians,
_STEP_RAD = 0.002
#: and as a share of the turn between the two;
_STEP_TURN = 0.02
#: translation, as a share of the distance between the two,
_STEP_WAY = 0.02
#: and of the median depth;
_STEP_DEPTH = 0.002
#: logarithm of the scale.
_STEP_SCALE = 0.01
#: The same across a gap in the tracks, where next to nothing is known: rotation in radians,
_GAP_RAD = 0.5
#: and logarithm of the scale.
_GAP_SCALE = 0.5


class Step(NamedTuple):
    """A constraint between two keyframes that are next to each other in the map.

    Attributes:
        constraint: Relative pose and its standard deviations; keyframes are numbered by their rows.
        is_thinned: Whether keyframes between them were thinned out.
        is_gap: Whether something else than tracking led from one to the other.
    """

    constraint: PoseConstraint
    is_thinned: bool
    is_gap: bool


def steps_of(world: WorldMap, keyframes: Sequence[Keyframe]) -> Iterator[Step]:
    """Yield the step to each keyframe of a submap from the one before it.

    Args:
        world: The map.
        keyframes: All of the submap, in order of time.
    """
    ever = np.array(sorted(k for k, part in world.submap_of.items() if part == keyframes[0].submap))
    gaps = np.array(sorted(world.gaps), dtype=np.int64)
    at = np.searchsorted(ever, [k.frame_id for k in keyframes])
    for row, (before, now) in enumerate(pairwise(keyframes), 1):
        num = int(at[row] - at[row - 1])
        if num == 1:
            missing = is_gap(before, now)
        else:
            missing = bool(((before.frame_id < gaps) & (gaps <= now.frame_id)).any())
        yield Step(_constraint(world, before, now, row, num, missing), num > 1, missing)


def _constraint(
    world: WorldMap, before: Keyframe, now: Keyframe, row: int, num_steps: int, missing: bool
) -> PoseConstraint:
    """Relative pose of the keyframe in ``row`` and the one before, which was ``num_steps`` keyframes ago."""
    T = invert_transform(before.T_world_cam) @ now.T_world_cam
    turn_rad = np.radians(rotation_angle_deg(T[:3, :3]))
    way = float(np.linalg.norm(T[:3, 3]))
    depth = usable_depth(world, now, way)
    if missing:
        return PoseConstraint(row - 1, row, T, 1.0, (_GAP_RAD, way + depth, _GAP_SCALE))
    grown = np.sqrt(num_steps)
    sigma = (
        grown * _STEP_RAD + _STEP_TURN * turn_rad,
        _STEP_WAY * way + grown * _STEP_DEPTH * depth,
        grown * _STEP_SCALE,
    )
    return PoseConstraint(row - 1, row, T, 1.0, sigma)


def usable_depth(world: WorldMap, keyframe: Keyframe, otherwise: float) -> float:
    """Median depth of a keyframe's landmarks; ``otherwise`` where it sees none any more."""
    depth = median_depth(world, keyframe)
    return depth if np.isfinite(depth) else max(otherwise, 1e-6)
