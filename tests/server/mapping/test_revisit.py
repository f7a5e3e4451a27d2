"""Landmarks of long ago that are in sight again: found, placed anew, and used."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.geometry.features import TrackedPoints, to_grey
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.mapper import build_problem
from semcast.server.mapping.recall import KeyframeImages, SeenFrom
from semcast.server.mapping.revisit import NUM_RECENT, find_revisit, place_anew
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import Sight, TrackTable, usable_rows
from semcast.server.mapping.world_map import Keyframe, WorldMap

SHAPE = (192, 256)
CAMERA = Intrinsics(fx=200.0, fy=200.0, cx=128.0, cy=96.0, width=SHAPE[1], height=SHAPE[0])
NOISE = NoiseModel(0.7, 0.0)
#: The scene is a wall at depth 2; a metre along it are 100 px.
DEPTH = 2.0


def wall():
    rng = np.random.default_rng(3)
    layers = [
        cv2.GaussianBlur(rng.standard_normal((900, 1800)).astype(np.float32), None, s) for s in (2, 5, 12)
    ]
    noise = sum(layer / layer.std() for layer in layers)
    return np.clip(noise * 30 + 128, 0, 255).astype(np.uint8)


WALL = wall()


def sight_from(T_world_cam, frame_id):
    """The wall as a camera sees it."""
    T = invert_transform(T_world_cam)
    on_wall = np.array([[0.01, 0, -4.5], [0, 0.01, -4.5], [0, 0, DEPTH], [0, 0, 1]])
    grey = cv2.warpPerspective(WALL, CAMERA.K @ (T[:3] @ on_wall), SHAPE[::-1], flags=cv2.INTER_LINEAR)
    frame = DecodedFrame(frame_id, frame_id * 10**8, np.repeat(grey[..., None], 3, axis=2))
    return Sight(frame, to_grey(frame.image), usable_rows(frame, SHAPE[0]))


def pose(x, y=0.0, z=0.0, turn_deg=(0.0, 0.0, 0.0)):
    return make_transform(exp_so3(np.radians(turn_deg)), [x, y, z])


def on_wall(T_world_cam, xy):
    """Where rays through pixels meet the wall."""
    ray = CAMERA.unproject(xy) @ T_world_cam[:3, :3].T
    return T_world_cam[:3, 3] + ray * ((DEPTH - T_world_cam[2, 3]) / ray[:, 2])[:, None]


@pytest.fixture
def mapped():
    """A map of a camera that went along the wall until it no longer saw where it began."""
    world, images, next_id = WorldMap(), KeyframeImages(50), 0
    for k in range(NUM_RECENT + 6):
        T = pose(0.4 * k)
        sight = sight_from(T, k)
        tracks = TrackTable("off", 120, 0)
        tracks.next_id = next_id
        tracks.remember(sight)
        tracks.refill(sight)
        next_id = tracks.next_id
        none = np.zeros(0, np.int64), np.zeros((0, 32), np.uint8)
        world.add_keyframe(Keyframe(k, k * 10**8, T, 0, tracks.ids, tracks.xy, tracks.confidence, *none))
        count = len(tracks)
        xyz = on_wall(T, tracks.xy)
        world.add_landmarks(tracks.ids, xyz, np.zeros((count, 3), np.uint8), np.ones(count), 0, k)
        images.append(SeenFrom(k, sight.grey))
    return world, images


def look(mapped, T_world_cam, T_believed=None, tracked=(), submap=0):
    world, images = mapped
    T_believed = T_world_cam if T_believed is None else T_believed
    sight = sight_from(T_world_cam, 100)
    ids = np.array(sorted(tracked), dtype=np.int64)
    return find_revisit(CAMERA, world, images, ids, sight, T_believed, submap=submap, gate_px=3.0)


def test_landmarks_of_long_ago_are_found_where_they_are(mapped):
    world, _ = mapped
    here = pose(0.1, 0.1, 0.15, (2.0, -4.0, 6.0))
    found = look(mapped, here)
    assert found.keyframe_id in (0, 1)
    ok = found.points.ok
    assert ok.sum() > 50
    seen = world.landmarks.xyz[world.landmarks.rows(found.ids)] @ here[:3, :3] - here[:3, 3] @ here[:3, :3]
    away = np.linalg.norm(found.points.xy - CAMERA.project(seen), axis=1)[ok]
    assert np.median(away) < 0.2
    assert away.max() < 3.0


def test_a_landmark_whose_depth_was_wrong_is_found_too_and_placed_anew(mapped, rng):
    world, _ = mapped
    truth = world.landmarks.xyz.copy()
    camera_at = np.array([world.poses[k][:3, 3] for k in world.landmarks.born.tolist()])
    stretch = rng.uniform(0.9, 1.15, len(truth))[:, None]
    world.landmarks.xyz = camera_at + (truth - camera_at) * stretch  # along the ray of the only view
    here = pose(0.2, 0.2)
    found = look(mapped, here)
    ok = found.points.ok
    assert ok.sum() > 40
    ids, xy = found.ids[ok], found.points.xy[ok]
    row = world.landmarks.rows(ids)
    before = np.linalg.norm(world.landmarks.xyz[row] - truth[row], axis=1)
    good = place_anew(CAMERA, world, found.keyframe_id, here, ids, xy, np.ones(len(ids)), NOISE)
    after = np.linalg.norm(world.landmarks.xyz[row] - truth[row], axis=1)
    assert good.mean() > 0.9
    assert np.median(before) > 0.05
    assert np.median(after[good]) < 0.02


def test_without_a_second_place_depths_stay_as_they_are(mapped):
    world, _ = mapped
    xyz = world.landmarks.xyz.copy()
    here = pose(0.005)
    found = look(mapped, here)
    ids, xy = found.ids[found.points.ok], found.points.xy[found.points.ok]
    good = place_anew(CAMERA, world, found.keyframe_id, here, ids, xy, np.ones(len(ids)), NOISE)
    assert good.mean() > 0.9, "they agree, they only tell no depth"
    np.testing.assert_array_equal(world.landmarks.xyz, xyz)


def test_a_point_on_which_rays_do_not_meet_is_not_used(mapped):
    world, _ = mapped
    here = pose(0.35)
    found = look(mapped, here)
    ids, xy = found.ids[found.points.ok], found.points.xy[found.points.ok].copy()
    xy[::2, 1] += 8.0  # across the epipolar lines
    good = place_anew(CAMERA, world, found.keyframe_id, here, ids, xy, np.ones(len(ids)), NOISE)
    assert not good[::2].any()
    assert good[1::2].mean() > 0.9


@pytest.mark.parametrize(
    ("here", "believed", "submap"),
    [
        (pose(6.0), pose(0.1), 0),  # another part of the wall is in sight
        (pose(0.1), pose(0.1, turn_deg=(6.0, 0.0, 0.0)), 0),  # so far off in pose that nothing agrees
        (pose(0.1), pose(0.1, turn_deg=(0.0, 120.0, 0.0)), 0),  # nothing old should be in sight
        (pose(0.1), pose(0.1), 1),  # of another submap the place is not known
    ],
)
def test_what_does_not_agree_is_no_revisit(mapped, here, believed, submap):
    assert look(mapped, here, believed, submap=submap) is None


def test_landmarks_that_are_tracked_are_not_looked_for(mapped):
    world, _ = mapped
    first = look(mapped, pose(0.05))
    ids = world.keyframes[first.keyframe_id].ids
    again = look(mapped, pose(0.05), tracked=ids.tolist())
    assert again is None or not np.isin(again.ids, ids).any()


def test_the_newest_keyframes_are_no_revisit(mapped):
    world, _ = mapped
    newest = world.keyframes[-1].T_world_cam
    found = look(mapped, newest)
    assert found is None or found.keyframe_id <= world.keyframes[-1 - NUM_RECENT].frame_id


def test_a_recognised_keyframe_holds_the_window(mapped):
    world, _ = mapped
    shared = world.keyframes[0].ids
    last = world.keyframes[-1]
    last.ids = np.concatenate([shared, last.ids])
    last.xy = np.concatenate([world.keyframes[0].xy, last.xy])
    last.confidence = np.ones(len(last.ids))
    without = build_problem(world, CAMERA, NOISE, 5)
    world.revisits[last.frame_id] = 0
    problem = build_problem(world, CAMERA, NOISE, 5)
    assert without is None, "no landmark of the window is seen twice"
    assert problem.keyframe_ids.tolist() == [0, *(k.frame_id for k in world.keyframes[-5:])]
    assert problem.fixed.tolist() == [True, True, True, False, False, False]
    assert problem.landmark_ids.tolist() == shared.tolist()


def test_images_are_thinned_out_from_the_old_end():
    images = KeyframeImages(10)
    for k in range(30):
        images.append(SeenFrom(k, np.zeros((2, 2), np.uint8)))
    ids = [image.frame_id for image in images]
    assert len(images) == len(ids) <= 10
    assert ids == sorted(ids)
    assert ids[-5:] == list(range(25, 30))
    assert ids[0] < 20
    assert [image.frame_id for image in images.newest(2)] == [28, 29]


def test_of_too_many_points_those_with_the_steepest_gradients_are_used():
    points = replace(
        TrackedPoints.none(4), ok=np.array([1, 1, 0, 1], bool), gradient_grey2=np.array([1, 9, 99, 5.0])
    )
    assert points.strongest(2).ok.tolist() == [False, True, False, True]
    assert points.strongest(0).ok.sum() == 0
    assert points.strongest(9).ok.tolist() == points.ok.tolist()
