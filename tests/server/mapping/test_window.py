"""What an adjustment takes of what keyframes saw."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform, transform_points
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping import mapper, window
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.window import build_problem, within_limit
from semcast.server.mapping.world_map import Keyframe, WorldMap

Ids = NDArray[np.int64]

CAMERA = Intrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)

#: Of eight landmarks so many observations each, in any order.
COUNT = np.array([2, 5, 1, 3, 5, 2, 4, 3])
IDS = np.arange(8) * 3 + 1
POINT = np.random.default_rng(0).permutation(np.repeat(np.arange(8), COUNT))


def test_all_that_is_seen_twice_is_taken_where_there_is_room():
    taken, kept, point = within_limit(IDS, POINT, -COUNT, limit=1000)
    assert taken.tolist() == [0, 1, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(taken[point], POINT[kept])
    assert kept.sum() == COUNT.sum() - 1


def test_beyond_the_limit_the_last_key_counts_first():
    assert within_limit(IDS, POINT, -COUNT, limit=14)[0].tolist() == [1, 4, 6]
    last = ~np.isin(np.arange(8), [0, 5])
    taken, kept, _ = within_limit(IDS, POINT, -COUNT, last, limit=14)
    assert taken.tolist() == [0, 1, 4, 5]
    assert kept.sum() == 14


def test_the_newest_keyframe_keeps_its_part_where_long_tracks_would_take_all(monkeypatch):
    """A camera that turns away from what it saw for long: nothing else places its newest keyframe."""
    monkeypatch.setattr(window, "MAX_OBSERVATIONS", 400)
    long_seen, new = np.arange(60), np.arange(100, 160)
    world = WorldMap()
    world.add_landmarks(
        np.concatenate([long_seen, new]),
        np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (120, 3)),
        np.zeros((120, 3), np.uint8),
        np.ones(120),
        0,
        0,
    )
    for k in range(20):
        ids = long_seen if k < 18 else np.concatenate([long_seen[:4], new])
        world.add_keyframe(_keyframe(k, ids))
    problem = build_problem(world, CAMERA, NoiseModel(0.5, 0.0), 10)
    assert problem is not None
    assert len(problem.xy) <= 400
    newest = problem.landmark_ids[problem.point[problem.view == len(problem.fixed) - 1]]
    assert np.isin(newest, new).sum() >= 50
    # And what ties the window to the keyframes before it keeps its own.
    assert np.isin(problem.landmark_ids, long_seen).sum() >= 5


@pytest.mark.parametrize(("num_stood", "window_size"), [(2, 20), (4, 12)])
def test_views_from_where_the_camera_stood_do_not_change_the_scale(num_stood, window_size):
    """How far apart they are is an error of their poses; all lengths would grow as if it were not."""
    rng = np.random.default_rng(0)
    ids, xyz = np.arange(80), rng.uniform((-2, -2, 4), (3, 2, 8), (80, 3))
    true_x = np.array([0.0, *np.full(num_stood - 1, 0.005), *np.arange(1, 12) * 0.1])
    world = WorldMap()
    world.add_landmarks(ids, xyz, np.zeros((80, 3), np.uint8), np.ones(80), 0, 0)
    for k, x in enumerate(true_x):
        T_world_cam = make_transform(np.eye(3), np.array([x, 0.0, 0.0]))
        xy = CAMERA.project(transform_points(invert_transform(T_world_cam), xyz))
        T_world_cam[0, 3] += 0.015 if 0 < k < num_stood else 0.0
        world.add_keyframe(replace(_keyframe(k, ids), T_world_cam=T_world_cam, xy=xy))
    if window_size < len(true_x):
        world.revisits[len(true_x) - 1] = 0  # where it stood holds the window from before it
    noise = OnlineNoise("robust", 0.5, 0.0, fit=False)
    for _ in range(3):
        problem = build_problem(world, CAMERA, noise.model, window_size)
        assert problem is not None
        mapper.apply_result(world, optimise(problem), noise)
    x = np.array([k.T_world_cam[0, 3] for k in world.keyframes])
    np.testing.assert_allclose(x - x[0], true_x, atol=0.02)


def _keyframe(number: int, ids: Ids) -> Keyframe:
    return Keyframe(
        frame_id=number,
        t_source_ns=number * 10**8,
        T_world_cam=make_transform(np.eye(3), np.array([0.2 * number, 0.0, 0.0])),
        submap=0,
        ids=ids,
        xy=np.full((len(ids), 2), 100.0),
        confidence=np.ones(len(ids)),
        descriptor_ids=np.zeros(0, np.int64),
        descriptors=np.zeros((0, 32), np.uint8),
    )
