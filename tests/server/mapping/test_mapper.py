from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, exp_so3, invert_transform, make_transform, transform_points
from semcast.server.geometry.edges import whiteners
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping import window
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.mapper import (
    KeyframeCues,
    add_landmarks,
    apply_result,
    local_scales,
    note_sight,
    usual_depth,
    wants_keyframe,
)
from semcast.server.mapping.window import build_problem
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
NOISE = NoiseModel(0.5, 0.0)
IMAGE = np.full((480, 640, 3), (10, 20, 30), np.uint8)


def make_world(num_keyframes=5, num_points=80, noise_px=0.2, step=0.3, seed=0, shake=0.0, way=None):
    rng = np.random.default_rng(seed)
    world = WorldMap()
    points = rng.uniform((-2, -1.5, 5), (3, 1.5, 10), (num_points, 3))
    truth = []
    for k, x in enumerate(step * np.arange(num_keyframes) if way is None else way):
        centre = (x, 0.15 * step * rng.normal(), 0.15 * x)
        T = make_transform(exp_so3(rng.normal(0, 0.02, 3)), centre)
        truth.append(T)
        xy = CAMERA.project(transform_points(invert_transform(T), points)) + rng.normal(
            0, noise_px, (num_points, 2)
        )
        shaken = T @ exp_se3(rng.normal(0, shake, 6)) if k >= 2 else T
        world.add_keyframe(
            Keyframe(
                frame_id=10 * k,
                t_source_ns=k,
                T_world_cam=shaken,
                submap=0,
                ids=np.arange(num_points),
                xy=xy,
                confidence=np.full(num_points, 0.8),
                descriptor_ids=np.zeros(0, np.int64),
                descriptors=np.zeros((0, 32), np.uint8),
            )
        )
    return world, points, np.stack(truth)


def put_landmarks(world, xyz):
    """Every point is a landmark, made by the first keyframe."""
    count = len(xyz)
    colour = np.zeros((count, 3), np.uint8)
    world.add_landmarks(np.arange(count), xyz, colour, np.ones(count), 0, 0)


def cues(**changes):
    values = {
        "num_inliers": 200,
        "num_inliers_at_keyframe": 220,
        "num_visible": 450,
        "max_features": 500,
        "median_flow_px": 10.0,
        "width_px": 640,
        "frames_since": 3,
        "usable_share": 1.0,
    }
    return KeyframeCues(**{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({}, False),
        ({"median_flow_px": 40.0}, True),
        ({"num_inliers": 150}, True),
        ({"num_inliers": 150, "frames_since": 1}, False),
        ({"num_visible": 200}, True),
        ({"num_inliers": 30}, True),
        ({"num_inliers": 30, "median_flow_px": 0.5}, False),
        ({"median_flow_px": 40.0, "usable_share": 0.3}, False),
        ({"num_inliers": 30, "usable_share": 0.3, "frames_since": 6}, True),
    ],
)
def test_the_keyframe_rule(changes, wanted):
    assert wants_keyframe(cues(**changes)) is wanted


def test_tracks_with_parallax_become_landmarks():
    world, points, _ = make_world()
    assert add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0) == len(world.landmarks) > 70
    row = world.landmarks.rows(np.arange(len(points)))
    error = np.linalg.norm(world.landmarks.xyz[row[row >= 0]] - points[row >= 0], axis=1)
    assert np.median(error) < 0.03
    inside = np.all(world.keyframes[-1].xy[world.landmarks.ids] >= 0, axis=1)
    assert np.all(world.landmarks.rgb[inside] == (10, 20, 30))
    assert np.allclose(world.landmarks.confidence, 0.8)
    assert add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0) == 0


def test_without_parallax_nothing_is_triangulated():
    world, _, _ = make_world(step=0.001)
    assert add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0) == 0


def test_smaller_angles_do_where_landmarks_run_out():
    def added(num_known, enough):
        world, points, _ = make_world(step=0.04)
        known = np.arange(num_known)
        rgb = np.zeros((num_known, 3), np.uint8)
        world.add_landmarks(known, points[known], rgb, np.ones(num_known), 0, 0)
        return add_landmarks(world, CAMERA, NOISE, IMAGE, 1.5, enough=enough)

    assert added(0, enough=0) < 20, "few have the parallax that is asked for"
    assert added(0, enough=40) > 60
    assert added(40, enough=40) < 10, "there are enough"
    assert added(10, enough=40) > 60
    assert added(10, enough=40) > added(35, enough=40) > added(40, enough=40)


def test_a_slipped_track_is_no_landmark():
    world, _, _ = make_world()
    world.keyframes[-1].xy[:10] += 12.0
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    assert np.all(world.landmarks.rows(np.arange(10)) == -1)


def test_an_adjustment_mends_shaken_poses():
    world, _, truth = make_world(8, 150, shake=0.01)
    add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.5)
    before = np.abs(np.stack([k.T_world_cam for k in world.keyframes]) - truth).max()
    world.add_frame(73, 70, world.poses[70])
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert problem is not None
    assert problem.fixed.tolist() == [True, True] + [False] * 6
    noise = OnlineNoise("robust", 0.5, 0.0, True)
    apply_result(world, optimise(problem), noise)
    after = np.abs(np.stack([k.T_world_cam for k in world.keyframes]) - truth).max()
    assert after < 0.2 * before
    assert np.allclose(world.pose_of_frame(73), world.poses[70])
    assert noise.model.sigma0_px < 0.5


def test_frames_between_keyframes_take_over_the_scale_that_an_adjustment_finds():
    world, _, truth = make_world(8, 150)
    add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.5)
    problem = build_problem(world, CAMERA, NOISE, 10)
    # All but the fixed ones were 1.5 times too large, and so was a frame on the way from one to the next.
    grown, first = 1.5, truth[1]
    for keyframe in world.keyframes[2:]:
        T = keyframe.T_world_cam.copy()
        T[:3, 3] = first[:3, 3] + grown * (T[:3, 3] - first[:3, 3])
        world.move_keyframe(keyframe.frame_id, T)
    on_the_way, between = np.eye(4), truth[5].copy()
    between[:3, 3] += 0.5 * (truth[6] - truth[5])[:3, 3]
    on_the_way[:3, 3] = grown * (invert_transform(truth[5]) @ between)[:3, 3]
    world.add_frame(53, 50, world.poses[50] @ on_the_way)
    xyz = problem.xyz.copy()
    asked = np.stack([world.poses[k] for k in problem.keyframe_ids.tolist()])
    depth = transform_points(invert_transform(truth[5]), xyz)
    large = replace(problem, T_world_cam=asked, xyz=transform_points(asked[5], grown * depth))
    result = replace(optimise(problem), problem=large)
    world.take_changes()
    apply_result(world, result, OnlineNoise("off", 0.5, 0.0, True))
    np.testing.assert_allclose(world.pose_of_frame(53)[:3, 3], between[:3, 3], atol=0.02)
    assert 53 in world.take_changes().frames, "receivers must be told"


def test_scale_around_a_keyframe_is_that_of_the_ways_to_its_neighbours():
    world, _, _ = make_world(5, 150)
    add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.5)
    problem = build_problem(world, CAMERA, NOISE, 10)

    def at(x):
        return np.stack([make_transform(np.eye(3), (each, 0.0, 0.0)) for each in x])

    # Ways before: 1, 1+1, 1+3, 3+0, 0. Afterwards: 2, 2+1, 1+6, 6+0, 0.
    first_fixed = replace(problem, T_world_cam=at([0, 1, 2, 5, 5]), fixed=np.arange(5) == 0)
    result = replace(optimise(problem), problem=first_fixed, T_world_cam=at([0, 2, 3, 9, 9]))
    np.testing.assert_allclose(local_scales(result), [1.0, 3 / 2, 7 / 4, 6 / 3, 1.0])
    # Things are five to ten away: ways of a thousandth are chance, of whatever share they change.
    turning = replace(result, problem=replace(first_fixed, T_world_cam=at([0.0, 0.001, 0.002, 0.003, 0.004])))
    np.testing.assert_array_equal(local_scales(turning), np.ones(5))


def test_the_fit_finds_the_noise_that_is_there_and_not_what_its_own_weights_make():
    true = NoiseModel(0.4, 3.0)
    noise = OnlineNoise("robust", 0.7, 0.0, True)
    for seed in range(14):
        rng = np.random.default_rng(100 + seed)
        world, _, _ = make_world(6, 160, noise_px=0.0, seed=seed)
        for keyframe in world.keyframes:
            keyframe.confidence[:] = rng.uniform(0.3, 1.0, len(keyframe.confidence))
            sigma = true.sigma_px(keyframe.confidence)[:, None]
            keyframe.xy += sigma * rng.normal(size=keyframe.xy.shape)
        add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.3)
        for keyframe in world.keyframes:  # short tracks: what is fitted to them hides half of their noise
            keyframe.drop_observations(rng.random(len(keyframe.ids)) < 0.4)
        problem = build_problem(world, CAMERA, noise.model, 10)
        assert problem is not None
        apply_result(world, optimise(problem), noise)
    assert 1.8 < noise.model.beta < 3.8  # 4.7 with uniform shrinkage
    assert noise.model.sigma0_px == pytest.approx(true.sigma0_px, rel=0.15)


def test_what_came_after_the_question_moves_with_the_answer():
    world, _, _ = make_world(5, 100, shake=0.01)
    add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.5)
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert problem is not None
    late = Keyframe(
        **{
            **vars(world.keyframes[-1]),
            "frame_id": 50,
            "T_world_cam": world.poses[40] @ exp_se3(np.full(6, 0.1)),
        }
    )
    world.add_keyframe(late)
    relative = invert_transform(world.poses[40]) @ world.poses[50]
    mark = transform_points(invert_transform(world.poses[50]), [[0.0, 0, 3]])
    world.add_landmarks(
        np.array([500]), np.array([[0.0, 0, 3]]), np.zeros((1, 3), np.uint8), np.ones(1), 0, 50
    )
    apply_result(world, optimise(problem), OnlineNoise("off", 0.5, 0.0, True))
    assert np.allclose(invert_transform(world.poses[40]) @ world.poses[50], relative)
    moved = world.landmarks.xyz[world.landmarks.rows(np.array([500]))]
    assert np.allclose(transform_points(invert_transform(world.poses[50]), moved), mark)


def test_a_landmark_that_was_made_again_since_the_question_keeps_its_new_place():
    world, _, _ = make_world(5, 100, shake=0.01)
    add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.5)
    result = optimise(build_problem(world, CAMERA, NOISE, 10))
    again = result.problem.landmark_ids[:1]
    mask = np.zeros(len(world.landmarks), bool)
    mask[world.landmarks.rows(again)] = True
    world.remove_landmarks(mask)
    last = world.keyframes[-1]
    world.add_keyframe(Keyframe(**{**vars(last), "frame_id": 50}))
    xyz = np.array([[1.0, 2, 33]])
    world.add_landmarks(again, xyz, np.zeros((1, 3), np.uint8), np.ones(1), 0, 50)
    in_last = transform_points(invert_transform(world.poses[40]), xyz)
    apply_result(world, result, OnlineNoise("off", 0.5, 0.0, True))
    moved = world.landmarks.xyz[world.landmarks.rows(again)]
    np.testing.assert_allclose(transform_points(invert_transform(world.poses[40]), moved), in_last, atol=1e-9)


def test_outliers_of_an_adjustment_are_dropped():
    world, _, _ = make_world(6, 100)
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    chosen = world.landmarks.ids[3]
    world.keyframes[3].xy[chosen] += 25.0
    problem = build_problem(world, CAMERA, NOISE, 10)
    apply_result(world, optimise(problem), OnlineNoise("off", 0.5, 0.0, True))
    assert chosen not in world.keyframes[3].ids
    assert chosen in world.keyframes[2].ids
    assert world.landmarks.rows(np.array([chosen]))[0] >= 0


def put_edges(world, rng, *, along_px=2.0, across_px=0.1):
    """Let all tracks slide along edges of all directions, which the keyframes know of."""
    for keyframe in world.keyframes:
        angle = rng.uniform(0, np.pi, len(keyframe.ids))
        along = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        keyframe.xy += along * rng.normal(0, along_px, (len(angle), 1))
        keyframe.xy += across * rng.normal(0, across_px, (len(angle), 1))
        keyframe.edge = 0.5 * np.log(along_px / across_px) * along


def test_tracks_that_slide_along_edges_become_landmarks_and_stay():
    world, _, _ = make_world(6, 100, noise_px=0.0)
    put_edges(world, np.random.default_rng(0))
    noise = OnlineNoise("robust", np.sqrt(0.2), 0.0, True)
    assert add_landmarks(world, CAMERA, noise.model, IMAGE, 1.0) > 90
    problem = build_problem(world, CAMERA, noise.model, 10)
    apply_result(world, optimise(problem), noise)
    assert min(len(k.ids) for k in world.keyframes) > 90, "2 pixels along an edge are no outlier"
    assert noise.model.sigma0_px == pytest.approx(np.sqrt(0.2), rel=0.15), "nor more noise than there is"
    world.keyframes[3].xy[world.keyframes[3].ids == 5] += 8.0 * whiteners(world.keyframes[3].edge[5:6])[0, 0]
    apply_result(world, optimise(build_problem(world, CAMERA, noise.model, 10)), noise)
    assert 5 not in world.keyframes[3].ids


def test_a_large_window_is_cut_to_what_several_keyframes_see():
    world, _, _ = make_world(10, 600)
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    for keyframe in world.keyframes[:8]:
        keyframe.drop_observations(keyframe.ids % 2 == 1)
    problem = build_problem(world, CAMERA, NOISE, 10)
    assert problem is not None
    assert len(problem.xy) <= window.MAX_OBSERVATIONS
    assert (problem.landmark_ids % 2 == 0).sum() >= (world.landmarks.ids % 2 == 0).sum() - 1


def test_a_landmark_that_keeps_disagreeing_is_given_up():
    world, _, _ = make_world()
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    bad = world.landmarks.ids[[5]]
    for frame_id in range(3):
        note_sight(world, bad, np.array([False]), frame_id)
    note_sight(world, bad, np.array([True]), 3)
    for frame_id in range(4, 8):
        assert world.landmarks.rows(bad)[0] >= 0
        note_sight(world, bad, np.array([False]), frame_id)
    assert world.landmarks.rows(bad)[0] == -1


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
    assert (build_problem(world, CAMERA, NOISE, 10).num_anchors > 0) == (first_held == 0)
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


def test_the_usual_depth_is_not_that_of_the_last_few_landmarks_before_a_loss():
    world, points, truth = make_world(num_keyframes=3, num_points=80)
    put_landmarks(world, points)
    usual = usual_depth(world, 50)
    assert 6.0 < usual < 9.0
    newest = world.keyframes[-1]
    newest.ids, newest.xy, newest.confidence = (a[:5] for a in (newest.ids, newest.xy, newest.confidence))
    near = transform_points(truth[-1], CAMERA.unproject(newest.xy) * 0.5)
    world.move_landmarks(newest.ids, near)
    assert usual_depth(world, 50) == pytest.approx(usual, rel=0.2)
    assert usual_depth(world, 81) == pytest.approx(0.5, rel=0.1), "none sees enough: that of the newest"
    assert usual_depth(WorldMap(), 50) == 1.0
