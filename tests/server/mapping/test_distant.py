"""Tracks without a landmark hold an adjustment, and are forgotten after it."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import (
    exp_se3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
    transform_points,
)
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping import distant
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.distant import distant_points
from semcast.server.mapping.mapper import apply_result
from semcast.server.mapping.window import build_problem
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
NOISE = NoiseModel(0.5, 0.0)
NUM_NEAR, NUM_FAR = 60, 120


def straight_ahead(seed=0, num_keyframes=6, noise_px=0.5, far_m=(100.0, 400.0), shake=0.0):
    """A camera that moves along its axis; what is near are landmarks, what is far are tracks alone."""
    rng = np.random.default_rng(seed)
    near = rng.uniform((-3, -2, 8), (3, 2, 14), (NUM_NEAR, 3))
    ray = CAMERA.unproject(rng.uniform((20, 20), (620, 460), (NUM_FAR, 2)))
    points = np.concatenate([near, ray * rng.uniform(*far_m, (NUM_FAR, 1))])
    world, truth = WorldMap(), []
    for k in range(num_keyframes):
        T = make_transform(np.eye(3), (0.0, 0.0, 0.3 * k))
        truth.append(T)
        xy = CAMERA.project(transform_points(invert_transform(T), points))
        shaken = T @ exp_se3(rng.normal(0, shake, 6)) if k else T
        world.add_keyframe(
            Keyframe(
                frame_id=10 * k,
                t_source_ns=k,
                T_world_cam=shaken,
                submap=0,
                ids=np.arange(len(points)),
                xy=xy + rng.normal(0, noise_px, xy.shape),
                confidence=np.full(len(points), 0.8),
                descriptor_ids=np.zeros(0, np.int64),
                descriptors=np.zeros((0, 32), np.uint8),
            )
        )
    colour = np.zeros((NUM_NEAR, 3), np.uint8)
    world.add_landmarks(np.arange(NUM_NEAR), near, colour, np.ones(NUM_NEAR), 0, 0)
    return world, points, np.stack(truth)


def placed(world, ids=None):
    ids = np.arange(NUM_NEAR, NUM_NEAR + NUM_FAR) if ids is None else ids
    return distant_points(world, CAMERA, NOISE, world.keyframes, ids)


def test_a_point_without_parallax_lies_in_its_direction_as_far_as_a_landmark_may():
    world, _, _ = straight_ahead(noise_px=0.1, far_m=(1e5, 2e5))
    found = placed(world)
    assert len(found.ids) > 0.9 * NUM_FAR
    newest = world.keyframes[-1]
    xy = CAMERA.project(transform_points(invert_transform(newest.T_world_cam), found.xyz))
    assert np.abs(xy - newest.xy[found.ids]).max() < 3.0
    depth = found.xyz[:, 2] - newest.T_world_cam[2, 3]
    assert depth.max() < 60.001 * 14
    assert np.median(depth) > 100


def test_a_point_with_some_parallax_is_placed_where_it_is():
    world, points, _ = straight_ahead(noise_px=0.02, far_m=(20.0, 25.0))
    found = placed(world)
    off = np.linalg.norm(points[found.ids, :2], axis=1) > 5.0  # near the axis nothing tells the depth
    assert off.sum() > 30
    ratio = found.xyz[off, 2] / points[found.ids[off], 2]
    assert np.abs(ratio - 1).max() < 0.05


def test_a_track_that_slipped_or_is_seen_once_is_not_placed():
    world, _, _ = straight_ahead()
    slipped, once = NUM_NEAR + 3, NUM_NEAR + 5
    world.keyframes[2].xy[slipped] += 12.0
    for keyframe in world.keyframes[1:]:
        keyframe.drop_observations(keyframe.ids == once)
    ids = placed(world).ids
    assert slipped not in ids
    assert once not in ids
    assert len(ids) > 0.9 * NUM_FAR


def test_there_are_no_more_than_there_is_room_for_and_the_longest_tracks_first(monkeypatch):
    world, _, _ = straight_ahead(noise_px=0.1)
    for keyframe in world.keyframes[:4]:
        keyframe.drop_observations(keyframe.ids >= NUM_NEAR + 40)
    monkeypatch.setattr(distant, "_MAX_POINTS", 30)
    ids = placed(world).ids
    assert 25 < len(ids) <= 30
    assert ids.max() < NUM_NEAR + 40


def test_nothing_is_placed_where_no_depth_is_known():
    world, _, _ = straight_ahead()
    world.remove_landmarks(np.ones(NUM_NEAR, bool))
    assert len(placed(world).ids) == 0
    assert len(placed(world, np.zeros(0, np.int64)).ids) == 0


def test_they_hold_the_rotation_and_the_direction_of_the_way(monkeypatch):
    errors = {}
    for room in (0, distant._MAX_POINTS):
        monkeypatch.setattr(distant, "_MAX_POINTS", room)
        errors[room] = []
        for seed in range(8):
            world, _, truth = straight_ahead(seed, shake=0.001)
            problem = build_problem(world, CAMERA, NOISE, 10, iterations=20)
            assert (len(problem.point_ids) > NUM_NEAR) == (room > 0)
            result = optimise(problem)
            assert result.ok
            errors[room].append(rotation_angle_deg(result.T_world_cam[-1, :3, :3] @ truth[-1, :3, :3].T))
    without, with_them = (np.mean(e) for e in errors.values())
    assert with_them < 0.4 * without


@pytest.mark.parametrize("became_landmark", [False, True])
def test_after_an_adjustment_they_are_forgotten(became_landmark):
    world, _, _ = straight_ahead(shake=0.003)
    problem = build_problem(world, CAMERA, NOISE, 10)
    track = problem.point_ids[-1:]
    assert track[0] >= NUM_NEAR
    result = optimise(problem)
    last = world.keyframes[-1]
    if became_landmark:  # while the adjustment ran, seen from a later keyframe
        world.add_keyframe(Keyframe(**{**vars(last), "frame_id": 60}))
        world.add_landmarks(track, np.array([[0.0, 0, 90]]), np.zeros((1, 3), np.uint8), np.ones(1), 0, 60)
    seen_from_last = transform_points(invert_transform(last.T_world_cam), [[0.0, 0, 90]])
    apply_result(world, result, OnlineNoise("off", 0.5, 0.0, True))
    row = world.landmarks.rows(problem.point_ids[problem.point_ids >= NUM_NEAR])
    assert (row >= 0).sum() == became_landmark
    if became_landmark:  # it has moved with the last keyframe, no more
        moved = world.landmarks.xyz[row[row >= 0]]
        np.testing.assert_allclose(
            transform_points(invert_transform(world.poses[50]), moved), seen_from_last, atol=1e-6
        )
