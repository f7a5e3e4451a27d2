"""How far away the scene is: the depth that lengths of a map are compared with."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.geometry.projection import depths_in
from semcast.server.mapping.track_ids import rows_among
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


def median_depth(world: WorldMap, keyframe: Keyframe) -> float:
    """Median depth of a keyframe's landmarks in map units; infinite when it sees none."""
    return median_depth_of(keyframe, world.landmarks.ids, world.landmarks.xyz)


def median_depth_of(keyframe: Keyframe, ids: Ids, xyz: Array) -> float:
    """Return the same for points ``ids (P,)``, ascending, at ``xyz (P, 3)``."""
    row = rows_among(keyframe.ids, ids)
    row = row[row >= 0]
    if len(row) == 0:
        return float("inf")
    depth = depths_in(invert_transform(keyframe.T_world_cam), xyz[row])
    return float(np.median(np.maximum(depth, 1e-6)))


def usual_depth(world: WorldMap, enough: int) -> float:
    """Median depth of what the newest keyframe sees that sees ``enough`` landmarks.

    The last ones before a loss see few, and those a camera that turned made under the smallest angles: their
    depth is anything. Where none sees enough, it is that of the newest; 1 without any landmark.
    """
    newest = world.keyframes[::-1]
    seen = (k for k in newest if (world.landmarks.rows(k.ids) >= 0).sum() >= enough)
    depth = median_depth(world, next(seen, newest[0])) if newest else 1.0
    return depth if np.isfinite(depth) else 1.0
