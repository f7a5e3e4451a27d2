"""What an adjustment had no room for goes where its keyframes went."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, exp_so3, invert_transform, make_transform, transform_points
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping import mapper, window
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.left_out import place_left_out
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
NOISE = NoiseModel(0.5, 0.0)
NUM_POINTS = 120


def world_with_shaken_keyframes(seed=0):
    """Eight keyframes, the last six a little off, and landmarks triangulated from where these seem to be."""
    rng = np.random.default_rng(seed)
    world = WorldMap()
    points = rng.uniform((-2, -1.5, 5), (4, 1.5, 10), (NUM_POINTS, 3))
    for k in range(8):
        T_world_cam = make_transform(
            exp_so3(rng.normal(0, 0.02, 3)), (0.3 * k, 0.05 * rng.normal(), 0.05 * k)
        )
        seen = CAMERA.project(transform_points(invert_transform(T_world_cam), points))
        shaken = T_world_cam @ exp_se3(rng.normal(0, 0.01, 6)) if k >= 2 else T_world_cam
        world.add_keyframe(
            Keyframe(
                frame_id=10 * k,
                t_source_ns=k,
                T_world_cam=shaken,
                submap=0,
                ids=np.arange(NUM_POINTS),
                xy=seen + rng.normal(0, 0.1, (NUM_POINTS, 2)),
                confidence=np.full(NUM_POINTS, 0.8),
                descriptor_ids=np.zeros(0, np.int64),
                descriptors=np.zeros((0, 32), np.uint8),
            )
        )
    mapper.add_landmarks(world, CAMERA, NoiseModel(8.0, 0.0), np.zeros((480, 640, 3), np.uint8), 0.5)
    assert len(world.landmarks) > 100
    return world, points


def adjusted(world, monkeypatch, max_observations):
    """Adjust with room for a part of the landmarks; the result and the ids of those without."""
    monkeypatch.setattr(window, "MAX_OBSERVATIONS", max_observations)
    problem = window.build_problem(world, CAMERA, NOISE, 10, iterations=20)
    left_out = np.setdiff1d(world.landmarks.ids, problem.landmark_ids)
    result = optimise(problem)
    mapper.apply_result(world, result, OnlineNoise("off", 0.5, 0.0, True))
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
    young = np.arange(0, NUM_POINTS, 2)
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
