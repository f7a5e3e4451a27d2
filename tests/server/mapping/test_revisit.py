"""Landmarks of long ago that are in sight again: found, placed anew, and used."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from textures import texture

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.geometry.grey import to_grey
from semcast.server.geometry.klt import TrackedPoints
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping import map_builder
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.keyframe_images import ImagedMap, KeyframeImages, SeenFrom
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.revisit import NUM_RECENT, find_revisit, place_anew
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.window import build_problem
from semcast.server.mapping.world_map import Keyframe, WorldMap

SHAPE = (192, 256)
CAMERA = Intrinsics(fx=200.0, fy=200.0, cx=128.0, cy=96.0, width=SHAPE[1], height=SHAPE[0])
NOISE = NoiseModel(0.7, 0.0)
#: The scene is a wall at depth 2; a metre along it are 100 px.
DEPTH = 2.0


@functools.cache
def wall():
    return texture((900, 1800), (2, 5, 12), 3)


def sight_from(T_world_cam, frame_id):
    """The wall as a camera sees it."""
    T = invert_transform(T_world_cam)
    on_wall = np.array([[0.01, 0, -4.5], [0, 0.01, -4.5], [0, 0, DEPTH], [0, 0, 1]])
    grey = cv2.warpPerspective(wall(), CAMERA.K @ (T[:3] @ on_wall), SHAPE[::-1], flags=cv2.INTER_LINEAR)
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
    xyz_of = np.zeros((0, 3))
    for k in range(NUM_RECENT + 6):
        T = pose(0.4 * k)
        sight = sight_from(T, k)
        xy = CAMERA.project(xyz_of @ T[:3, :3] - T[:3, 3] @ T[:3, :3])
        again = np.flatnonzero(((xy > 12) & (xy < np.array(SHAPE[::-1]) - 12)).all(axis=1))
        tracks = TrackTable("off", 120, 0)
        tracks.remember(sight)
        tracks.adopt(again, xy[again], 1.0)
        tracks.next_id = next_id
        tracks.refill(sight)
        world.add_keyframe(Keyframe(k, k * 10**8, T, 0, tracks.ids, tracks.xy, tracks.confidence))
        new = tracks.ids >= next_id
        next_id = tracks.next_id
        xyz = on_wall(T, tracks.xy[new])
        xyz_of = np.concatenate([xyz_of, xyz])
        count = len(xyz)
        world.add_landmarks(tracks.ids[new], xyz, np.zeros((count, 3), np.uint8), np.ones(count), 0, k)
        images.append(SeenFrom(k, sight.grey))
    return world, images


def look(mapped, T_world_cam, T_believed=None, tracked=(), submap=0):
    world, images = mapped
    T_believed = T_world_cam if T_believed is None else T_believed
    sight = sight_from(T_world_cam, 100)
    ids = np.array(sorted(tracked), dtype=np.int64)
    return find_revisit(ImagedMap(CAMERA, world, images, submap), ids, sight, T_believed, gate_px=3.0)


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


def place(mapped, found, T_world_cam):
    return place_anew(CAMERA, mapped[0], found, T_world_cam, NOISE, 1.0)


def stretched(world, rng):
    """Move every landmark along the ray of the keyframe that made it; the truth."""
    truth = world.landmarks.xyz.copy()
    camera_at = np.array([world.poses[k][:3, 3] for k in world.landmarks.born.tolist()])
    world.landmarks.xyz = camera_at + (truth - camera_at) * rng.uniform(0.9, 1.15, len(truth))[:, None]
    return truth


def test_a_landmark_whose_depth_was_wrong_is_found_too_and_placed_anew(mapped, rng):
    world, _ = mapped
    truth = stretched(world, rng)
    here = pose(0.2, 0.2)
    found = look(mapped, here)
    row = world.landmarks.rows(found.ids)
    before = np.linalg.norm(world.landmarks.xyz[row] - truth[row], axis=1)
    ok = place(mapped, found, here).ok
    after = np.linalg.norm(world.landmarks.xyz[row] - truth[row], axis=1)
    assert ok.sum() > 40
    assert ok.sum() > 0.9 * found.points.ok.sum()
    assert np.median(before[ok]) > 0.05
    assert np.median(after[ok]) < 0.02


def test_where_few_agree_with_one_place_it_is_by_chance(mapped, rng):
    world, _ = mapped
    here = pose(0.2, 0.2)
    found = look(mapped, here)
    points = found.points
    wrong = np.flatnonzero(points.ok)[: int(0.9 * points.ok.sum())]
    xy = points.xy.copy()
    xy[wrong] += rng.choice([-1.0, 1.0], (len(wrong), 2)) * rng.uniform(15.0, 40.0, (len(wrong), 2))
    before = world.landmarks.xyz.copy()
    assert not place(mapped, replace(found, points=replace(points, xy=xy)), here).ok.any()
    np.testing.assert_array_equal(world.landmarks.xyz, before)


def test_where_rays_tell_no_depth_a_landmark_stays_and_has_to_be_seen_there(mapped, rng):
    world, _ = mapped
    here = pose(0.005)
    found = look(mapped, here)
    for keyframe in world.keyframes:  # only one keyframe saw them
        if keyframe.frame_id != found.keyframe_id:
            keyframe.drop_observations(np.isin(keyframe.ids, found.ids))
    xyz = world.landmarks.xyz.copy()
    ok = place(mapped, found, here).ok
    assert ok.sum() > 0.9 * found.points.ok.sum()
    np.testing.assert_array_equal(world.landmarks.xyz, xyz)
    found.points.xy[::2, 0] += 6.0
    ok = place(mapped, found, here).ok
    assert not ok[::2].any()
    np.testing.assert_array_equal(world.landmarks.xyz, xyz)


@pytest.mark.parametrize("off_px", [(0.0, 8.0), (5.0, 0.0), (30.0, 0.0)])
def test_a_point_that_one_ray_misses_is_not_used(mapped, off_px):
    """Across the epipolar lines and along them: many old rays must not outvote the new one."""
    here = pose(0.35)
    found = look(mapped, here)
    found.points.xy[::2] += off_px
    often = sum(np.isin(found.ids, k.ids) for k in mapped[0].keyframes) > 2
    ok = place(mapped, found, here).ok
    assert often[::2].sum() > 20
    assert not ok[::2][often[::2]].any()
    assert ok[1::2].sum() > 0.9 * found.points.ok[1::2].sum()


def test_a_depth_that_becomes_quite_another_is_that_of_another_point(mapped):
    """Two rays meet wherever a match is taken along the line."""
    world, _ = mapped
    here = pose(-0.35)
    found = look(mapped, here)
    for keyframe in world.keyframes:
        if keyframe.frame_id != found.keyframe_id:
            keyframe.drop_observations(np.isin(keyframe.ids, found.ids))
    assert found.keyframe_id == 0
    to_old = here[0, 3] - world.poses[found.keyframe_id][0, 3]
    found.points.xy[::2, 0] += 0.75 * to_old * CAMERA.fx / DEPTH  # as far as a point at four times the depth
    ok = place(mapped, found, here).ok
    assert not ok[::2].any()
    assert ok[1::2].sum() > 0.9 * found.points.ok[1::2].sum()


def reused(mapped, T_world_cam, T_believed=None, max_landmarks=20_000, young=40):
    """A map builder after a frame that came back, its tracks, and the landmarks taken up."""
    world, images = mapped
    settings = ReconstructionSettings(confidence="off", max_features=120, max_landmarks=max_landmarks)
    builder = MapBuilder(CAMERA, settings, InlineBundle(), on_moved=print)
    builder.world, builder.images = world, images
    sight = sight_from(T_world_cam, 100)
    tracks = TrackTable("off", young, 0)
    tracks.next_id = int(world.landmarks.ids[-1]) + 1
    tracks.remember(sight)
    tracks.refill(sight)
    T_believed = T_world_cam if T_believed is None else T_believed
    changed = builder.revisit(tracks, sight, T_believed)
    again = tracks.ids[world.landmarks.rows(tracks.ids) >= 0]
    assert changed == (len(again) > 0)
    assert np.all(np.diff(tracks.ids) > 0)
    return builder, sight, tracks, again


def test_old_landmarks_get_tracks_and_young_tracks_in_their_places_give_way(mapped):
    world, _ = mapped
    builder, _, tracks, again = reused(mapped, pose(0.1, 0.05))
    assert len(again) > 40
    assert len(tracks) > 40, "no fewer than before"
    assert list(world.revisits) == [100]
    assert set(again.tolist()) <= set(
        next(k for k in world.keyframes if k.frame_id == world.revisits[100]).ids
    )
    away = np.linalg.norm(tracks.xy[:, None] - tracks.xy[None], axis=2) + 99.0 * np.eye(len(tracks))
    old = np.isin(tracks.ids, again)
    assert away[old][:, ~old].min() > 4.0
    assert np.all(world.landmarks.last_seen[world.landmarks.rows(again)] == 100)
    builder._adjuster._bundle.close()


def test_what_can_not_be_used_costs_no_young_track(mapped, rng):
    stretched(mapped[0], rng)
    _, _, tracks, again = reused(mapped, pose(0.1), pose(0.1, turn_deg=(0.6, 0.0, 0.0)))
    assert len(tracks) >= 40 - len(again)
    assert len(tracks) >= 38


def test_landmarks_taken_up_are_not_the_first_to_go(mapped):
    world, _ = mapped
    builder, sight, tracks, again = reused(mapped, pose(0.1), max_landmarks=len(mapped[0].landmarks) - 5)
    before = set(world.landmarks.ids.tolist())
    builder.make_keyframe(sight, tracks, pose(0.1))
    assert not before <= set(world.landmarks.ids.tolist()), "some went"
    assert np.all(world.landmarks.rows(again) >= 0)


def test_tracks_stay_about_as_many_as_wanted(mapped):
    _, _, tracks, again = reused(mapped, pose(0.1), young=140)
    assert len(again) > 0
    assert len(tracks) <= 1.2 * 120


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
    first = look(mapped, pose(0.05))
    again = look(mapped, pose(0.05), tracked=first.ids[::3].tolist())
    assert np.isin(again.ids, first.ids).sum() > 20
    assert not np.isin(again.ids, first.ids[::3]).any()


def test_the_newest_keyframes_are_no_revisit(mapped):
    world, _ = mapped
    assert look(mapped, world.keyframes[-1].T_world_cam) is None
    found = look(mapped, world.keyframes[-NUM_RECENT].T_world_cam)
    assert found.keyframe_id == world.keyframes[-NUM_RECENT - 1].frame_id, "the last one before them"


def test_recognised_keyframes_and_those_around_them_hold_the_window(mapped):
    world, _ = mapped
    problem = build_problem(world, CAMERA, NOISE, 5)
    newest = [k.frame_id for k in world.keyframes[-5:]]
    assert problem.keyframe_ids[problem.num_anchors :].tolist() == newest
    assert problem.keyframe_ids.min() > 2, "the beginning is out of sight"
    builder, sight, tracks, _ = reused(mapped, pose(0.1))
    builder.make_keyframe(sight, tracks, pose(0.1))
    problem = build_problem(world, CAMERA, NOISE, 5)
    assert problem.num_anchors >= 2
    assert world.revisits[100] in problem.keyframe_ids[: problem.num_anchors]
    assert problem.fixed.tolist() == [True] * (problem.num_anchors + 1) + [False] * 4
    assert set(problem.landmark_ids.tolist()) <= set(
        np.concatenate([k.ids for k in world.keyframes[-5:]]).tolist()
    )


def test_an_adjustment_with_them_takes_the_drift_out_of_the_newest_pose(mapped):
    world, _ = mapped
    true, believed = pose(0.3, 0.1), pose(0.31, 0.11, 0.01)
    builder, sight, tracks, again = reused(mapped, true, believed)
    assert len(again) > 30
    builder.make_keyframe(sight, tracks, believed)
    builder.collect(wait=True)
    away = np.linalg.norm(world.poses[100][:3, 3] - true[:3, 3])
    assert away < 0.3 * np.linalg.norm(believed[:3, 3] - true[:3, 3])


def drifted(mapped, true, scale, moved):
    """A builder, with sight, tracks and pose of a frame in a part of the map that has drifted."""
    world, images = mapped
    settings = ReconstructionSettings(confidence="off", max_features=120)
    builder = MapBuilder(CAMERA, settings, InlineBundle(), on_moved=moved.append)
    builder.world, builder.images = world, images
    drift = pose(0.02, 0.03, 0.02, (0.3, 0.4, 0.0))
    believed = drift @ make_transform(true[:3, :3], scale * true[:3, 3])
    sight = sight_from(true, 100)
    tracks = TrackTable("off", 80, 0)
    tracks.next_id = int(world.landmarks.ids[-1]) + 1
    tracks.remember(sight)
    tracks.refill(sight)
    # The young tracks have landmarks already, in the drifted part's place and unit.
    young = scale * on_wall(true, tracks.xy) @ drift[:3, :3].T + drift[:3, 3]
    newest = 90
    seen = tracks.ids, tracks.xy, tracks.confidence
    world.add_keyframe(Keyframe(newest, newest * 10**8, drift @ pose(0.2 * scale), 0, *seen))
    colour = np.zeros((len(young), 3), np.uint8)
    world.add_landmarks(tracks.ids, young, colour, np.ones(len(young)), 0, newest)
    world.add_frame(100, newest, believed)
    return builder, sight, tracks, believed


def test_a_loop_is_closed_before_old_landmarks_are_placed_by_what_drifted(mapped):
    world, _ = mapped
    true, scale, moved = pose(0.1, 0.05), 1.1, []
    builder, sight, tracks, believed = drifted(mapped, true, scale, moved)
    young_ids = tracks.ids
    before = world.landmarks.xyz[world.landmarks.born == 0].copy()
    assert builder.revisit(tracks, sight, believed)
    assert moved == [pytest.approx(1 / scale, rel=0.04)]
    np.testing.assert_allclose(world.pose_of_frame(100)[:3, 3], true[:3, 3], atol=0.03)
    xyz_young = world.landmarks.xyz[world.landmarks.rows(young_ids)]
    assert np.median(np.abs(xyz_young[:, 2] - DEPTH)) < 0.05
    after = world.landmarks.xyz[world.landmarks.born == 0]
    assert np.median(np.linalg.norm(after - before, axis=1)) < 0.02, "the old part stays"
    assert world.revisits[90] in (0, 1)


def test_nothing_is_taken_up_at_a_place_whose_loop_was_refused(mapped, monkeypatch):
    world, _ = mapped
    builder, sight, tracks, believed = drifted(mapped, pose(0.1, 0.05), 1.1, [])
    before = world.landmarks.xyz.copy()
    refused = []
    monkeypatch.setattr(map_builder, "share_out", lambda *loop: refused.append(loop))
    young_ids = tracks.ids
    for _ in range(5):  # neither then nor at the next keyframes, which see the same
        assert not builder.revisit(tracks, sight, believed)
    assert len(refused) == 2
    assert np.array_equal(tracks.ids, young_ids)
    assert np.array_equal(world.landmarks.xyz, before)
    assert world.revisits == {}


def test_images_are_thinned_out_from_the_old_end():
    images = KeyframeImages(10)
    for k in range(30):
        images.append(SeenFrom(k, np.zeros((2, 2), np.uint8)))
    ids = [image.frame_id for image in images]
    assert len(images) == len(ids) <= 10
    assert ids == sorted(ids)
    assert ids[-5:] == list(range(25, 30))
    assert ids[0] == 0
    assert max(np.diff(ids)) <= 10
    assert [image.frame_id for image in images.newest(2)] == [28, 29]
    images.keep({0, 28})
    assert [image.frame_id for image in images] == [0, 28]


def test_of_too_many_points_those_with_the_steepest_gradients_are_used():
    points = replace(
        TrackedPoints.none(4), ok=np.array([1, 1, 0, 1], bool), gradient_grey2=np.array([1, 9, 99, 5.0])
    )
    assert points.strongest(2).ok.tolist() == [False, True, False, True]
    assert points.strongest(0).ok.sum() == 0
    assert points.strongest(9).ok.tolist() == points.ok.tolist()
