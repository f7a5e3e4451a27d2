"""Whether a place that was recognised may join two submaps: the camera must have been able to get there.

The motion before a gap is known well. A place that asks for another turn, or for another way, than the camera
can have made in a short gap is one that only looks the same: the next corridor, or the next of equal doors.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import make_transform, rotation_angle_deg
from semcast.server.geometry.motion import ConstantVelocity
from semcast.server.mapping.world_map import Keyframe

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: A submap turned from where it was put by more than this was not recognised,
_MOST_TURNED_DEG = 30.0
#: with so much more for each second of the gap before it.
_MOST_TURNED_DEG_S = 60.0
#: The beginning of a submap may be off by this share of its way: its scale is not exactly what the join says.
_WAY_SHARE = 0.2
#: There is a gap where so many times as many frames have no pose as from one pose to the next before.
_GAP_STEPS = 3.0
#: Poses by which that is told.
_NUM_POSED = 10


def may_join(
    older: Sequence[Keyframe],
    newer: Sequence[Keyframe],
    scale: float,
    T_join: Array,
    *,
    posed_ids: Ids,
    depth: float,
) -> bool:
    """Whether the camera can have got from one submap into another, if they are joined in some way.

    Args:
        older: Keyframes of the submap that began first, in order of time.
        newer: Those of the other; both submaps have some.
        scale: Units of the older one per unit of the newer one.
        T_join: ``(4, 4)``; ``T_join @ (scale * x)`` is where a point of the newer one would be.
        posed_ids: ``(N,)`` frames that have a pose, ascending.
        depth: Of the scene, map units of the older one.
    """
    first, newest = newer[0], newer[-1]
    before = [k for k in older if k.t_source_ns < first.t_source_ns]
    if not before:
        return True
    gap_s = (first.t_source_ns - before[-1].t_source_ns) * 1e-9
    if rotation_angle_deg(T_join[:3, :3]) > _MOST_TURNED_DEG + _MOST_TURNED_DEG_S * gap_s:
        return False
    if not _is_gap(posed_ids[posed_ids < first.frame_id], first.frame_id):
        return True
    motion = ConstantVelocity()
    for keyframe in before:
        motion.observe(keyframe.t_source_ns, keyframe.T_world_cam)
    there = motion.whereabouts(first.t_source_ns, depth)
    if there is None:
        return True
    T_began, T_ended = (
        make_transform(T_join[:3, :3] @ T[:3, :3], T_join[:3, :3] @ (scale * T[:3, 3]) + T_join[:3, 3])
        for T in (first.T_world_cam, newest.T_world_cam)
    )
    slack = _WAY_SHARE * float(np.linalg.norm(T_ended[:3, 3] - T_began[:3, 3]))
    return there.astray(T_began) <= there.radius + slack


def _is_gap(before_ids: Ids, first_id: int) -> bool:
    """Tell whether frames without a pose lie before a frame; else a recording was cut: no way leads there."""
    last = before_ids[-_NUM_POSED:]
    return len(last) > 1 and bool(first_id - last[-1] > _GAP_STEPS * np.median(np.diff(last)))
