"""What of a map goes out to those who follow it."""

import numpy as np

from semcast.server.mapping.state import MapUpdate
from semcast.server.mapping.world_map import MapChanges, WorldMap


def update_of(world: WorldMap, changes: MapChanges, map_epoch: int) -> MapUpdate:
    """Return changes of a map with what they are now.

    Args:
        world: The map.
        changes: Of it.
        map_epoch: Of the map.
    """
    ids, removed, keyframes, frames, withdrawn = changes
    row = world.landmarks.rows(ids)
    _, frame_poses = world.poses_of_frames(frames)  # a run of hours has a hundred thousand
    return MapUpdate(
        map_epoch=map_epoch,
        ids=ids,
        xyz=world.landmarks.xyz[row].copy(),
        rgb=world.landmarks.rgb[row].copy(),
        confidence=world.landmarks.confidence[row].copy(),
        removed=removed,
        keyframe_ids=keyframes,
        keyframe_poses=np.array([world.poses[k] for k in keyframes.tolist()]).reshape(-1, 4, 4),
        frame_ids=frames,
        frame_poses=frame_poses,
        withdrawn=withdrawn,
    )
