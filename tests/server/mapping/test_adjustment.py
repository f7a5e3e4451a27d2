from dataclasses import replace

import numpy as np
import pytest
from cloud_of_points import CAMERA, IMAGE, NOISE, make_world

from semcast.common.geometry import exp_se3, invert_transform, make_transform, transform_points
from semcast.server.geometry.edges import whiteners
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping import window
from semcast.server.mapping.adjustment import apply_result, local_scales, place_left_out
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.new_landmarks import add_landmarks
from semcast.server.mapping.window import build_problem
from semcast.server.mapping.world_map import Keyframe


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


def test_a_landmark_that_was_made_again_is_not_judged_by_where_it_was():
    world, _, _ = make_world(5, 100)
    add_landmarks(world, CAMERA, NoiseModel(6.0, 0.0), IMAGE, 0.5)
    problem = build_problem(world, CAMERA, NOISE, 10)
    again = int(problem.landmark_ids[0])
    xy = problem.xy + np.where(problem.point[:, None] == 0, 40.0 * (problem.view[:, None] - 2), 0.0)
    result = optimise(replace(problem, xy=xy))
    world.remove_landmarks(world.landmarks.ids == again)
    world.add_keyframe(Keyframe(**{**vars(world.keyframes[-1]), "frame_id": 50}))
    one = np.zeros((1, 3), np.uint8), np.ones(1), 0, 50
    world.add_landmarks(np.array([again]), np.array([[1.0, 2, 33]]), *one)
    apply_result(world, result, OnlineNoise("off", 0.5, 0.0, True))
    assert again in world.landmarks.ids
    assert all(again in keyframe.ids for keyframe in world.keyframes)


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


def world_with_shaken_keyframes():
    """Eight keyframes, the last six a little off, and landmarks triangulated from where these seem to be."""
    world, points, _ = make_world(8, 120, noise_px=0.1, shake=0.01)
    add_landmarks(world, CAMERA, NoiseModel(8.0, 0.0), IMAGE, 0.5)
    assert len(world.landmarks) > 100
    return world, points


def adjusted(world, monkeypatch, max_observations):
    """Adjust with room for a part of the landmarks; the result and the ids of those without."""
    monkeypatch.setattr(window, "MAX_OBSERVATIONS", max_observations)
    problem = window.build_problem(world, CAMERA, NOISE, 10, iterations=20)
    left_out = np.setdiff1d(world.landmarks.ids, problem.landmark_ids)
    result = optimise(problem)
    apply_result(world, result, OnlineNoise("off", 0.5, 0.0, True))
    return result, left_out


def error_of(world, ids, points):
    return float(
        np.median(np.linalg.norm(world.landmarks.xyz[world.landmarks.rows(ids)] - points[ids], axis=1))
    )


def test_landmarks_left_out_are_placed_from_the_mended_keyframes(monkeypatch):
    world, points = world_with_shaken_keyframes()
    result, left_out = adjusted(world, monkeypatch, 400)
    assert len(left_out) > 50
    before = error_of(world, left_out, points)
    assert place_left_out(world, CAMERA, NOISE, result) == len(left_out)
    after = error_of(world, left_out, points)
    assert before > 0.03
    assert after < 0.01
    # As good as those the adjustment held.
    assert after < 2 * error_of(world, result.problem.landmark_ids, points)


def test_landmarks_of_the_adjustment_stay_where_it_put_them(monkeypatch):
    world, _ = world_with_shaken_keyframes()
    result, _ = adjusted(world, monkeypatch, 400)
    place_left_out(world, CAMERA, NOISE, result)
    held = world.landmarks.xyz[world.landmarks.rows(result.problem.landmark_ids)]
    np.testing.assert_array_equal(held, result.xyz)


def test_landmarks_whose_rays_do_not_meet_stay(monkeypatch):
    world, _ = world_with_shaken_keyframes()
    result, left_out = adjusted(world, monkeypatch, 400)
    slipped = left_out[:5]
    world.keyframes[4].xy[slipped] += 40.0
    before = world.landmarks.xyz[world.landmarks.rows(slipped)].copy()
    assert place_left_out(world, CAMERA, NOISE, result) == len(left_out) - 5
    np.testing.assert_array_equal(world.landmarks.xyz[world.landmarks.rows(slipped)], before)


def test_landmarks_that_slid_along_their_edge_are_placed_by_what_is_known_across_it(monkeypatch):
    world, points = world_with_shaken_keyframes()
    result, left_out = adjusted(world, monkeypatch, 400)
    for k, keyframe in enumerate(world.keyframes):
        keyframe.xy[left_out, 1] += 2.5 * (-1) ** k
        keyframe.edge = np.zeros_like(keyframe.xy)
        keyframe.edge[left_out] = (0.0, 0.5 * np.log(10.0))  # upright, known across it ten times as well
    assert place_left_out(world, CAMERA, NOISE, result) == len(left_out)
    assert error_of(world, left_out, points) < 0.01


def test_landmarks_need_two_keyframes_and_one_that_was_moved(monkeypatch):
    world, points = world_with_shaken_keyframes()
    result, left_out = adjusted(world, monkeypatch, 400)
    assert result.problem.fixed.tolist() == [True, True] + [False] * 6
    by_fixed, by_one, by_two = left_out[:3]
    for k, keyframe in enumerate(world.keyframes):
        gone = [(by_fixed, k > 1), (by_one, k != 4), (by_two, k not in (2, 7))]
        keyframe.drop_observations(np.isin(keyframe.ids, [track for track, is_gone in gone if is_gone]))
    before = world.landmarks.xyz[world.landmarks.rows(left_out[:2])].copy()
    assert place_left_out(world, CAMERA, NOISE, result) == len(left_out) - 2
    np.testing.assert_array_equal(world.landmarks.xyz[world.landmarks.rows(left_out[:2])], before)
    assert error_of(world, by_two[None], points) < 0.03


def test_landmarks_born_later_and_of_other_submaps_stay(monkeypatch):
    world, _ = world_with_shaken_keyframes()
    result, left_out = adjusted(world, monkeypatch, 400)
    row = world.landmarks.rows(left_out)
    world.landmarks.born[row[0]] = 75
    world.landmarks.submap[row[1]] = 1
    before = world.landmarks.xyz[row[:2]].copy()
    assert place_left_out(world, CAMERA, NOISE, result) == len(left_out) - 2
    np.testing.assert_array_equal(world.landmarks.xyz[row[:2]], before)


@pytest.mark.parametrize("spoil", ["failed", "everything fits"])
def test_without_anything_left_out_or_an_adjustment_nothing_moves(monkeypatch, spoil):
    world, _ = world_with_shaken_keyframes()
    result, _ = adjusted(world, monkeypatch, 400 if spoil == "failed" else 100_000)
    if spoil == "failed":
        result = replace(result, ok=False)
    before = world.landmarks.xyz.copy()
    assert place_left_out(world, CAMERA, NOISE, result) == 0
    np.testing.assert_array_equal(world.landmarks.xyz, before)


def test_room_in_an_adjustment_goes_to_new_landmarks_as_to_old_ones():
    """Half of the landmarks are seen by all keyframes, half by the newest four: both get their share."""
    world, _ = world_with_shaken_keyframes()
    young = world.keyframes[0].ids[::2].copy()
    for keyframe in world.keyframes[:4]:
        keyframe.drop_observations(np.isin(keyframe.ids, young))
    problem_ids = {}
    for limit in (300, 100_000):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(window, "MAX_OBSERVATIONS", limit)
            problem_ids[limit] = window.build_problem(world, CAMERA, NOISE, 10).landmark_ids
    share = np.isin(problem_ids[300], young).mean()
    assert len(problem_ids[300]) < len(problem_ids[100_000])
    assert 0.3 < share < 0.7


def test_a_map_whose_landmarks_are_all_gone_has_none_to_place(monkeypatch):
    world, _ = world_with_shaken_keyframes()
    result, _ = adjusted(world, monkeypatch, 400)
    world.remove_landmarks(np.ones(len(world.landmarks), bool))
    assert place_left_out(world, CAMERA, NOISE, result) == 0
