"""How well a pose is known: against the newest keyframes, and with them against the start of the map."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.mapping.guessed_place import carried
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]


def pose_covariance(
    world: WorldMap, submap: int, covariance_in_map: Array | None, T_world_cam: Array
) -> Array | None:
    """Covariance of a frame: its own, the drift of the newest adjusted keyframe carried over, and a guess's.

    Args:
        world: The map.
        submap: Part of it the frame is in.
        covariance_in_map: ``(6, 6)`` of the frame relative to the map, in the camera frame.
        T_world_cam: Its pose.

    Returns:
        ``(6, 6)``, rotation before translation; None where it is not known, as of a submap that was put
        somewhere with nothing to tell how far off that is.
    """
    if covariance_in_map is None:
        return None
    found = covariance_in_map
    for keyframe in reversed(world.keyframes):
        if keyframe.submap == submap and (drift := world.drift.of(keyframe.frame_id)) is not None:
            found = found + carried(drift, invert_transform(keyframe.T_world_cam) @ T_world_cam)[:6, :6]
            break
    if (guess := world.guesses.get(submap)) is None:
        return found
    guessed = guess.seen_from(invert_transform(world.poses[guess.frame_id]) @ T_world_cam)
    return None if guessed is None else np.asarray(found + guessed[:6, :6])
