"""Looks again for landmarks that are in sight but have lost their track, where the pose expects them.

Rows that did not arrive, a blur or a jerk end tracks; their landmarks are still in the map. They are followed
from the newest keyframes they were seen in, whose images are kept. How the light has changed since then is
told by tracks that go on: where these are is known. Streaks of motion blur are told by the images as a whole.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.brightness import MIN_POINTS, brightness_change, with_brightness
from semcast.server.geometry.corners import BORDER_PX
from semcast.server.geometry.klt import TrackedPoints, track_alike, track_points
from semcast.server.geometry.streaks import blurred_alike
from semcast.server.mapping.keyframe_images import ImagedMap, SeenFrom
from semcast.server.mapping.sight import Seen, Sight
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import Keyframe

Array = NDArray[np.float64]

#: Keyframes that are looked at here, the newest ones.
_NUM_RECALLED = 3
#: Pyramid levels: where it is expected is known well.
_LEVELS = 1


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
    T_cam_world, alive = invert_transform(T_world_cam), tracks.seen()
    found = [np.zeros(0, np.int64)]
    for image, keyframe in reversed(mapped.newest_views(_NUM_RECALLED)):
        if sum(map(len, found)) >= wanted:
            break
        row = mapped.world.landmarks.rows(keyframe.ids)
        lost = np.flatnonzero((row >= 0) & ~np.isin(keyframe.ids, tracks.ids, assume_unique=True))
        points_cam = transform_points(T_cam_world, mapped.world.landmarks.xyz[row[lost]])
        expected = mapped.camera.project(points_cam)
        in_sight = sight.shows(expected, BORDER_PX)
        lost, expected = lost[in_sight], expected[in_sight]
        if len(lost):
            points = _follow(image, keyframe, lost, sight, expected, alive)
            near = np.linalg.norm(points.xy - expected, axis=1) < reach_px
            points = replace(points, ok=points.ok & near)
            found.append(tracks.bring_back(sight, keyframe.ids[lost], points))
    return np.concatenate(found)


def _follow(
    image: SeenFrom,
    keyframe: Keyframe,
    rows: NDArray[np.intp],
    sight: Sight,
    expected_xy: Array,
    alive: Seen,
) -> TrackedPoints:
    """Follow some of what a keyframe saw into a new image, in the light that tracks seen in both tell of."""
    xy0 = keyframe.xy[rows]
    grey0, grey1 = blurred_alike(image.grey, sight.grey, image.band_power, sight.band_power)
    then, now = shared_rows(keyframe.ids, alive.ids)
    if len(then) < MIN_POINTS:
        return track_points(grey0, grey1, xy0, expected_xy, max_level=_LEVELS)
    change = brightness_change(grey0, grey1, keyframe.xy[then], alive.xy[now])
    grey0 = grey0 if change is None else with_brightness(grey0, *change)
    return track_alike(grey0, grey1, xy0, expected_xy, max_level=_LEVELS)
