from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform, transform_points
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.kept_frames import Observed, backfill, colours_of, keyframe_of, pose_of
from semcast.server.mapping.look_back import look_back
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.world_map import WorldMap

CAMERA = Intrinsics(fx=400.0, fy=400.0, cx=320.0, cy=240.0, width=640, height=480)
NOISE = NoiseModel(0.5, 0.0)
SETTINGS = ReconstructionSettings()
NUM_FRAMES, NUM_START = 40, 8


def turn(angle_deg):
    a = np.radians(angle_deg)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


@pytest.fixture
def walk(rng):
    """A camera that walks and turns in a round room: the last frames share nothing with the first."""
    angle, away = rng.uniform(-2.6, 1.0, 1500), rng.uniform(3, 5, 1500)
    xyz = np.column_stack([away * np.sin(angle), rng.uniform(-2, 2, 1500), away * np.cos(angle)])
    T_world_cam = [
        make_transform(turn(-2.5 * k), [-0.03 * k, 0.01 * np.sin(k), 0.0]) for k in range(NUM_FRAMES)
    ][::-1]
    # In the frame of the first view of the start, as starts are.
    T_start_world = np.linalg.inv(T_world_cam[-NUM_START])
    T_world_cam = [T_start_world @ T for T in T_world_cam]
    xyz = transform_points(T_start_world, xyz)
    frames = []
    for k, T in enumerate(T_world_cam):
        points_cam = transform_points(np.linalg.inv(T), xyz)
        xy = CAMERA.project(points_cam)
        seen = (points_cam[:, 2] > 0.1) & (xy > 0).all(axis=1) & (xy < (640, 480)).all(axis=1)
        ids = np.flatnonzero(seen)
        frames.append(
            Observed(k, k * 10**8, ids, xy[ids] + rng.normal(0, 0.3, (len(ids), 2)), np.ones(len(ids)))
        )
    return T_world_cam, xyz, frames


@pytest.fixture
def start(walk):
    T_world_cam, xyz, frames = walk
    chosen = [NUM_FRAMES - NUM_START, NUM_FRAMES - 4, NUM_FRAMES - 1]
    ids = np.unique(np.concatenate([frames[k].ids for k in chosen]))
    keyframes = [keyframe_of(frames[k], T_world_cam[k]) for k in chosen]
    return Start(keyframes, ids, xyz[ids], np.ones(len(ids)))


def test_a_start_grows_over_frames_that_see_nothing_of_it(walk, start):
    T_world_cam, xyz, frames = walk
    before = frames[: NUM_FRAMES - NUM_START]
    first = before[0]
    assert pose_of(CAMERA, first, start.ids, start.xyz, NOISE, np.eye(4), 0) is None
    grown = look_back(CAMERA, start, before, NOISE, SETTINGS)
    order = [k.frame_id for k in grown.keyframes]
    assert order == sorted(order)
    assert order[-3:] == [k.frame_id for k in start.keyframes]
    assert 3 <= len(order) - 3 <= 10
    assert np.all(np.diff(grown.ids) > 0)
    assert len(grown.ids) == len(grown.xyz) == len(grown.confidence) > 1.3 * len(start.ids)
    np.testing.assert_allclose(grown.keyframes[0].T_world_cam, np.eye(4), atol=1e-12)
    # The same places and the same unit, seen from the first keyframe.
    T_first = T_world_cam[order[0]]
    for keyframe in grown.keyframes:
        true = np.linalg.inv(T_first) @ T_world_cam[keyframe.frame_id]
        assert np.linalg.norm(keyframe.T_world_cam[:3, 3] - true[:3, 3]) < 0.08
    error = np.linalg.norm(grown.xyz - transform_points(np.linalg.inv(T_first), xyz[grown.ids]), axis=1)
    assert np.median(error) < 0.1


def test_frames_between_get_poses_by_the_keyframe_after_them(walk, start):
    T_world_cam, _, frames = walk
    before = frames[: NUM_FRAMES - NUM_START]
    grown = look_back(CAMERA, start, before, NOISE, SETTINGS)
    world = WorldMap()
    for keyframe in grown.keyframes:
        world.add_keyframe(keyframe)
    count = len(grown.ids)
    world.add_landmarks(
        grown.ids, grown.xyz, np.zeros((count, 3), np.uint8), grown.confidence, 0, NUM_FRAMES - 1
    )
    posed = backfill(CAMERA, world, grown.keyframes, frames[:-1], NOISE, 0)
    first_id = grown.keyframes[0].frame_id
    assert {frame_id for frame_id, _, _ in posed} >= set(range(first_id, NUM_FRAMES - 1))
    T_first = T_world_cam[first_id]
    for frame_id, _, T in posed:
        if frame_id < first_id:
            continue
        true = np.linalg.inv(T_first) @ T_world_cam[frame_id]
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.08
    ids = [k.frame_id for k in grown.keyframes]
    between = [frame_id for frame_id in range(first_id, NUM_FRAMES - 1) if frame_id not in ids]
    assert len(between) > 2
    for frame_id in between:
        assert world.frames[frame_id][0] == min(k for k in ids if k >= frame_id)


def test_without_earlier_frames_a_start_stays_as_it_is(start):
    grown = look_back(CAMERA, start, [], NOISE, SETTINGS)
    assert [k.frame_id for k in grown.keyframes] == [k.frame_id for k in start.keyframes]
    np.testing.assert_allclose(grown.xyz, start.xyz, atol=1e-12)


def test_frames_of_another_place_are_passed_over(start, rng):
    ids = np.arange(10**6, 10**6 + 200)
    elsewhere = [Observed(k, k * 10**8, ids, rng.uniform(0, 480, (200, 2)), np.ones(200)) for k in range(5)]
    grown = look_back(CAMERA, start, elsewhere, NOISE, SETTINGS)
    assert len(grown.keyframes) == len(start.keyframes)


def test_landmarks_have_the_colour_of_their_last_sight():
    frames = [
        Observed(
            k,
            k,
            np.array(ids),
            np.zeros((len(ids), 2)),
            np.ones(len(ids)),
            np.full((len(ids), 3), k, np.uint8),
        )
        for k, ids in ((1, [3, 5, 8]), (2, [5, 9]))
    ]
    frames.append(Observed(3, 3, np.array([8]), np.zeros((1, 2)), np.ones(1)))
    assert colours_of(np.array([3, 4, 5, 8]), frames)[:, 0].tolist() == [1, 128, 2, 1]


def test_a_camera_that_was_somewhere_else_for_long_is_not_looked_for_further_back(walk, start, rng):
    _, _, frames = walk
    before = frames[: NUM_FRAMES - NUM_START]
    found = {}
    for num_elsewhere in (5, 16):
        others = [
            Observed(100, 0, np.arange(10**6, 10**6 + 50), rng.uniform(0, 480, (50, 2)), np.ones(50))
            for _ in range(num_elsewhere)
        ]
        history = [replace(o, frame_id=k) for k, o in enumerate([*before[-12:], *others])]
        later = [replace(k, frame_id=k.frame_id + 1000) for k in start.keyframes]
        found[num_elsewhere] = look_back(CAMERA, replace(start, keyframes=later), history, NOISE, SETTINGS)
    assert len(found[5].keyframes) > len(start.keyframes)
    assert len(found[16].keyframes) == len(start.keyframes)
