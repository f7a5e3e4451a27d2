"""Tracks through motion blur that draws each image out in another direction."""

from dataclasses import replace

import cv2
import numpy as np
from shifted_texture import CAMERA, START_X, mapped_wall, pose_at, sight_at

from semcast.server.geometry.streaks import Streak
from semcast.server.mapping.keyframe_images import ImagedMap, KeyframeImages, SeenFrom
from semcast.server.mapping.recall import recall_landmarks
from semcast.server.mapping.tracks import TrackTable

FIRST, SECOND = Streak(25.0, np.radians(20)), Streak(25.0, np.radians(110))
MOVED = 6


def streaked_sight(streak, x, frame_id=0):
    """Details as fine as a camera shows, as one sees them that shakes."""
    sight = sight_at(x, frame_id=frame_id)
    fine = np.random.default_rng(7).integers(0, 2, (100, 200)).astype(np.uint8) * 120
    boxes = cv2.resize(fine, None, fx=5, fy=5, interpolation=cv2.INTER_NEAREST)[:192, x : x + 256]
    return replace(sight, grey=streak.laid_on(cv2.addWeighted(sight.grey, 0.5, boxes, 0.8, 0)))


def begun(sight):
    tracks = TrackTable("robust", 150, 0)
    tracks.remember(sight)
    tracks.refill(sight)
    return tracks, tracks.ids.copy(), tracks.xy.copy()


def assert_followed(tracks, ids, xy):
    seen = tracks.visible
    assert seen.sum() > 0.8 * len(ids)
    where = xy[np.searchsorted(ids, tracks.ids[seen])] - (MOVED, 0)
    assert np.median(np.linalg.norm(tracks.xy[seen] - where, axis=1)) < 0.3


def test_tracks_are_followed_from_streaks_into_others():
    tracks, ids, xy = begun(streaked_sight(FIRST, START_X))
    tracks.follow(streaked_sight(SECOND, START_X + MOVED, 1), tracks.xy)
    assert_followed(tracks, ids, xy)


def test_a_second_look_knows_the_streaks_of_the_image_before():
    first, second = streaked_sight(FIRST, START_X), streaked_sight(SECOND, START_X + MOVED, 1)
    tracks, ids, xy = begun(first)
    tracks.remember(first)
    tracks.follow(second, tracks.xy)
    assert tracks.follow_again(second, lambda table: table.xy)
    assert_followed(tracks, ids, xy)


def test_an_image_that_takes_the_place_of_another_has_its_own_streaks():
    first = streaked_sight(FIRST, START_X)
    tracks, ids, xy = begun(first)
    tracks.remember(streaked_sight(SECOND, START_X))
    tracks.replace_newest(first)
    tracks.follow(streaked_sight(SECOND, START_X + MOVED, 1), tracks.xy)
    assert_followed(tracks, ids, xy)


def test_landmarks_are_recalled_from_streaks_into_others():
    world, _, tracks = mapped_wall()
    images = KeyframeImages(10)
    first = streaked_sight(FIRST, START_X)
    images.append(SeenFrom(0, first.grey))
    second = streaked_sight(SECOND, START_X + MOVED, 1)
    tracks.keep(np.arange(len(tracks)) < 0)
    tracks.remember(second)
    count = len(world.landmarks)
    found = recall_landmarks(
        ImagedMap(CAMERA, world, images, 0),
        tracks,
        second,
        pose_at(START_X + MOVED),
        reach_px=6.0,
        wanted=1000,
    )
    expected = CAMERA.project(world.landmarks.xyz[world.landmarks.rows(found)]) - (MOVED, 0)
    off_px = np.linalg.norm(tracks.xy[np.searchsorted(tracks.ids, found)] - expected, axis=1)
    assert len(found) > 0.7 * count
    assert np.median(off_px) < 0.3
