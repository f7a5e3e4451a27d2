"""Looks again for landmarks that are in sight but have lost their track, where the pose expects them.

Rows that did not arrive, a blur or a jerk end tracks; their landmarks are still in the map. They are followed
from the newest keyframes they were seen in, whose images are kept.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, transform_points
from semcast.server.mapping.keyframe_images import ImagedMap
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.tracks import TrackTable

Array = NDArray[np.float64]

#: Keyframes that are looked at here, the newest ones.
_NUM_RECALLED = 3
#: A point is looked for no nearer to the border than this.
_BORDER_PX = 8


def recall_landmarks(
    mapped: ImagedMap,
    tracks: TrackTable,
    sight: Sight,
    T_world_cam: Array,
    *,
    reach_px: float,
    wanted: int,
) -> NDArray[np.int64]:
    """Look for landmarks of the newest keyframes that have no track; each found one gets its track back.

    Args:
        mapped: Landmarks and keyframes.
        tracks: After the new image was followed; grows.
        sight: The new image.
        T_world_cam: Its pose, or the expected one.
        reach_px: A point found further than this from where it is expected is another one.
        wanted: Once this many are found, no older keyframe is looked at.

    Returns:
        Ids of the tracks that were found.
    """
    T_cam_world = invert_transform(T_world_cam)
    found = [np.zeros(0, np.int64)]
    for image, keyframe in reversed(mapped.newest_views(_NUM_RECALLED)):
        if sum(map(len, found)) >= wanted:
            break
        row = mapped.world.landmarks.rows(keyframe.ids)
        lost = np.flatnonzero((row >= 0) & ~np.isin(keyframe.ids, tracks.ids, assume_unique=True))
        points_cam = transform_points(T_cam_world, mapped.world.landmarks.xyz[row[lost]])
        expected = mapped.camera.project(points_cam)
        in_sight = sight.shows(expected, _BORDER_PX)
        lost, expected = lost[in_sight], expected[in_sight]
        if len(lost):
            seen = keyframe.ids[lost], keyframe.xy[lost]
            found.append(tracks.take_up(sight, image.grey, *seen, expected, reach_px))
    return np.concatenate(found)
