"""What an adjustment takes of what keyframes saw."""

from dataclasses import replace

import numpy as np
import pytest
from cloud_of_points import CAMERA, IMAGE, NOISE, make_world, put_landmarks
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, make_transform, transform_points
from semcast.server.geometry.weighting import OnlineNoise
from semcast.server.mapping import window
from semcast.server.mapping.adjustment import apply_result
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.new_landmarks import add_landmarks
from semcast.server.mapping.window import build_problem, within_limit
from semcast.server.mapping.world_map import Keyframe, WorldMap

Ids = NDArray[np.int64]

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
    problem = build_problem(world, CAMERA, NOISE, 10)
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
        apply_result(world, optimise(problem), noise)
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
    )


def test_a_large_window_is_cut_to_what_several_keyframes_see():
    world, _, _ = make_world(10, 600)
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    for keyframe in world.keyframes[:8]:
        keyframe.drop_observations(keyframe.ids % 2 == 1)
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert problem is not None
    assert len(problem.xy) <= window.MAX_OBSERVATIONS
    assert (problem.landmark_ids % 2 == 0).sum() >= (world.landmarks.ids % 2 == 0).sum() - 1


def test_there_is_nothing_to_adjust_at_first():
    world, _, _ = make_world(2)
    assert build_problem(world, CAMERA, NOISE, 10) is None
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    assert build_problem(world, CAMERA, NOISE, 10) is None
    assert build_problem(world, CAMERA, NOISE, 10, start=True) is not None


def test_the_first_adjustment_of_a_map_is_held_by_a_pose_and_a_distance():
    world, points, _ = make_world(num_keyframes=4)
    put_landmarks(world, points)
    for start in (True, False):
        problem = build_problem(world, CAMERA, NOISE, 10, start=start)
        assert problem.fixed.tolist() == [True, not start, False, False]
        assert problem.keep_baseline == start
        assert problem.sets_unit
    world.bound(1000, 3, recent=3)
    assert not build_problem(world, CAMERA, NOISE, 10).sets_unit, "it was set before one of them went"


def test_a_window_whose_newest_held_keyframe_sees_no_landmark_is_held_as_others_are():
    world, points, _ = make_world(num_keyframes=4)
    put_landmarks(world, points)
    lost = world.keyframes[1]
    lost.drop_observations(np.ones(len(lost.ids), bool))
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert problem.fixed.tolist() == [True, True, False, False]
    assert not problem.keep_baseline


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_keyframes_before_the_window_keep_its_scale_where_keyframes_are_dense(monkeypatch, seed):
    """Ten keyframes within 1/70 of the depth hardly know a scale; those before saw the same landmarks."""
    way = np.concatenate([0.3 * np.arange(6), 1.5 + 0.01 * np.arange(1, 11)])
    monkeypatch.setattr(window, "_LEAST_WAY", 0.0)  # for two of the window to hold it without those before
    error = {}
    for num_before in (0, window._MAX_BEFORE):
        monkeypatch.setattr(window, "_MAX_BEFORE", num_before)
        world, points, _ = make_world(noise_px=0.5, step=0.0, seed=seed, way=way)
        put_landmarks(world, points * np.random.default_rng(seed).uniform(0.95, 1.05, (len(points), 1)))
        problem = build_problem(world, CAMERA, NOISE, 10)
        assert problem.num_anchors == num_before
        assert problem.fixed.sum() == (2 if num_before == 0 else num_before + 1)
        xyz = optimise(problem).xyz
        error[num_before > 0] = abs(np.log(np.median(xyz[:, 2] / points[problem.landmark_ids, 2])))
    assert error[True] < 0.01
    assert error[False] > 3 * error[True]


@pytest.mark.parametrize(("step", "first_held"), [(0.05, 0), (0.3, 5)])
def test_a_window_of_some_extent_is_not_held_by_the_start_of_the_map(step, first_held):
    world, points, _ = make_world(num_keyframes=14, step=step)
    put_landmarks(world, points)
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert (problem.num_anchors > 0) == (first_held == 0)
    assert not problem.sets_unit, "keyframes before it did, whether they hold it or not"
    world, points, _ = make_world(num_keyframes=34, step=step)
    put_landmarks(world, points)
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert problem.num_anchors > 1
    assert problem.keyframe_ids[0] // 10 == first_held
    assert problem.fixed.sum() == problem.num_anchors + 1


def test_of_many_keyframes_before_the_window_some_hold_it_evenly():
    world, points, _ = make_world(num_keyframes=40, step=0.02)
    put_landmarks(world, points)
    problem = build_problem(world, CAMERA, NOISE, 10)
    before = problem.keyframe_ids[: problem.num_anchors] // 10
    assert before.tolist() == [0, 5, 11, 17, 23, 29]
    for keyframe in world.keyframes[:30]:
        keyframe.drop_observations(keyframe.ids >= 5)
    assert build_problem(world, CAMERA, NOISE, 10).num_anchors == 0, "five landmarks in common say little"
