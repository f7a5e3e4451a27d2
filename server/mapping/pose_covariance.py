"""How well a pose is known: against the newest keyframes, and with them against the rest of the map."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.mapping.guessed_place import similarity_adjoint
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]


def pose_covariance(
    world: WorldMap,
    submap: int,
    adjusted: tuple[int, Array] | None,
    covariance_in_map: Array | None,
    T_world_cam: Array,
) -> Array | None:
    """Covariance of a frame: that of the last adjusted keyframe carried over, its own, and a guess's.

    Args:
        world: The map.
        submap: Part of it the frame is in.
        adjusted: A keyframe's frame id and the covariance ``(6, 6)`` of its pose; None without.
        covariance_in_map: ``(6, 6)`` of the frame relative to the map, in the camera frame.
        T_world_cam: Its pose.

    Returns:
        ``(6, 6)``, rotation before translation; None where it is not known, as of a submap that was put
        somewhere with nothing to tell how far off that is.
    """
    if covariance_in_map is None:
        return None
    found = covariance_in_map
    if adjusted is not None and world.submap_of[adjusted[0]] == submap:
        keyframe_id, covariance = adjusted
        carried = similarity_adjoint(invert_transform(world.poses[keyframe_id]) @ T_world_cam)[:6, :6]
        found = found + carried @ covariance @ carried.T
    if (guess := world.guesses.get(submap)) is None:
        return found
    guessed = guess.seen_from(invert_transform(world.poses[guess.frame_id]) @ T_world_cam)
    return None if guessed is None else np.asarray(found + guessed[:6, :6])
