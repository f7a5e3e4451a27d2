"""All keyframes adjusted at once: what drifted is put right, and what hangs on nothing stays."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import (
    exp_se3,
    exp_so3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
    transform_points,
)
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping import whole_map
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.whole_map import adjust_whole_map
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=300, fy=300, cx=160, cy=120, width=320, height=240)
NOISE = NoiseModel(0.5, 0.0)
#: A camera turns once round in the middle of a room and sees some of the first landmarks again at the end.
NUM_KEYFRAMES, NUM_POINTS = 36, 1500


def true_pose(k):
    """Looking outwards on a small circle, a little further than once round."""
    turn = exp_so3(np.array([0.0, 2.3 * np.pi * k / NUM_KEYFRAMES, 0.0]))
    return make_transform(turn, turn @ np.array([0.0, 0.0, 1.0]))


def points_of_a_room(rng):
    angle, height = rng.uniform(0, 2 * np.pi, NUM_POINTS), rng.uniform(-2, 2, NUM_POINTS)
    radius = rng.uniform(4, 7, NUM_POINTS)
    return np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=1)


def drifted_world(sees=lambda k, ids: ids, step_sd=0.004, growth=1.004, seed=0):
    """A map of the room whose error grows keyframe by keyframe: direction, place and scale.

    Args:
        sees: Which of the landmarks in sight a keyframe takes.
    """
    rng = np.random.default_rng(seed)
    points = points_of_a_room(rng)
    world = WorldMap()
    T_drifted, scale = true_pose(0), 1.0
    placed = np.full((NUM_POINTS, 3), np.nan)
    for k in range(NUM_KEYFRAMES):
        if k:
            scale *= growth
            step = invert_transform(true_pose(k - 1)) @ true_pose(k)
            step[:3, 3] *= scale
            T_drifted = T_drifted @ step @ exp_se3(rng.normal(0, step_sd, 6))
        cam = transform_points(invert_transform(true_pose(k)), points)
        xy = CAMERA.project(np.where(cam[:, 2:] > 0.1, cam, [0, 0, 1.0]))
        inside = (cam[:, 2] > 0.1) & (xy > 0).all(axis=1) & (xy < [320, 240]).all(axis=1)
        ids = sees(k, np.flatnonzero(inside))
        new = ids[np.isnan(placed[ids, 0])]
        placed[new] = transform_points(T_drifted, scale * cam[new])
        world.add_keyframe(keyframe(k, T_drifted, ids, xy[ids] + rng.normal(0, 0.3, (len(ids), 2))))
        world.add_landmarks(new, placed[new], np.zeros((len(new), 3), np.uint8), np.ones(len(new)), 0, 10 * k)
        world.add_frame(10 * k, 10 * k, T_drifted)
    return world, points


def keyframe(k, T_world_cam, ids, xy):
    return Keyframe(
        frame_id=10 * k,
        t_source_ns=k,
        T_world_cam=T_world_cam,
        submap=0,
        ids=ids,
        xy=xy,
        confidence=np.ones(len(ids)),
    )


def errors_m(world):
    """Of every keyframe's place; the first one is where it is by definition."""
    return np.array(
        [np.linalg.norm(k.T_world_cam[:3, 3] - true_pose(n)[:3, 3]) for n, k in enumerate(world.keyframes)]
    )


def median_error_m(world, points):
    """Of the landmarks' places."""
    return float(np.median(np.linalg.norm(world.landmarks.xyz - points[world.landmarks.ids], axis=1)))


def test_what_drifted_is_put_right_where_a_place_is_seen_again():
    world, points = drifted_world()
    before, points_before = errors_m(world), median_error_m(world, points)
    assert adjust_whole_map(world, CAMERA, NOISE) == NUM_KEYFRAMES
    after = errors_m(world)
    assert before.max() > 0.1
    assert after.max() < 0.25 * before.max()
    # Landmarks and frames go with the keyframes.
    assert median_error_m(world, points) < 0.5 * points_before
    for k in (0, 17, 35):
        np.testing.assert_allclose(world.pose_of_frame(10 * k), world.keyframes[k].T_world_cam, atol=1e-12)


def test_what_does_not_fit_is_dropped():
    world, _ = drifted_world()
    wrong = world.keyframes[20]
    wrong.xy[:5] += 40.0
    ids = wrong.ids[:5].copy()
    adjust_whole_map(world, CAMERA, NOISE)
    assert not np.isin(ids, wrong.ids).any()
    assert errors_m(world).max() < 0.05


def test_parts_that_share_nothing_are_adjusted_each_for_itself():
    """After a cut nothing but a guess says where the second part is: it keeps its place by the first one."""
    cut = 15

    def sees(k, ids):
        even = ids % 2 == 0
        return ids[even] if k < cut else ids[~even]

    world, _ = drifted_world(sees)
    parts = (0, cut - 1), (cut, NUM_KEYFRAMES - 1)
    before = [way_error(world, *part) for part in parts]
    step_before = invert_transform(world.keyframes[cut - 1].T_world_cam) @ world.keyframes[cut].T_world_cam
    assert adjust_whole_map(world, CAMERA, NOISE) == NUM_KEYFRAMES
    step_after = invert_transform(world.keyframes[cut - 1].T_world_cam) @ world.keyframes[cut].T_world_cam
    assert rotation_angle_deg(step_before[:3, :3].T @ step_after[:3, :3]) < 1e-6
    # Its unit may change with that of the part before it, and nothing else.
    ratio = np.linalg.norm(step_after[:3, 3]) / np.linalg.norm(step_before[:3, 3])
    np.testing.assert_allclose(step_after[:3, 3], ratio * step_before[:3, 3], rtol=1e-6)
    assert 0.9 < ratio < 1.1
    for part, error in zip(parts, before, strict=True):
        assert way_error(world, *part) < 0.8 * error


def way_error(world, first, last):
    """Largest error of a turn within a part, radians."""
    T_first = invert_transform(world.keyframes[first].T_world_cam)
    T_true = invert_transform(true_pose(first))
    return max(
        np.radians(
            rotation_angle_deg(
                (T_true @ true_pose(k))[:3, :3].T @ (T_first @ world.keyframes[k].T_world_cam)[:3, :3]
            )
        )
        for k in range(first, last + 1)
    )


def test_keyframes_that_were_thinned_out_follow_the_one_before():
    world, _ = drifted_world()
    world.bound(max_landmarks=10_000, max_keyframes=30, recent=10)
    gone = next(
        k for k in range(NUM_KEYFRAMES) if 10 * k not in {x.frame_id for x in world.keyframes} and k > 10
    )
    before = invert_transform(world.poses[10 * (gone - 1)]) @ world.poses[10 * gone]
    place = world.poses[10 * gone].copy()
    assert adjust_whole_map(world, CAMERA, NOISE) == len(world.keyframes)
    after = invert_transform(world.poses[10 * (gone - 1)]) @ world.poses[10 * gone]
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-9)
    assert np.linalg.norm(world.poses[10 * gone] - place) > 1e-3


def thinned_world(num_shared, **drift):
    """Every second keyframe of the room is left; it shares so many landmarks with the next, none with others.

    So nothing but the steps says how long one is next to another.
    """
    first = {}

    def sees(k, ids):
        mine = [n for n in ids.tolist() if k // 2 - first.setdefault(n, k // 2) <= 1]
        rank = {
            n: r for at in {first[n] for n in mine} for r, n in enumerate(n for n in first if first[n] == at)
        }
        return np.array([n for n in mine if rank[n] < num_shared], np.int64)

    world, _ = drifted_world(sees, **drift)
    world.keyframes = world.keyframes[::2]
    return world


def way_errors(world):
    """Of the length of each step, as a share."""

    def ways(places):
        return np.linalg.norm(np.diff(places, axis=0), axis=1)

    is_way = ways(np.stack([k.T_world_cam[:3, 3] for k in world.keyframes]))
    return is_way / ways(np.stack([true_pose(k.frame_id // 10)[:3, 3] for k in world.keyframes])) - 1.0


@pytest.mark.parametrize("num_shared", [15, 100])
def test_how_far_thinned_out_keyframes_were_apart_is_not_forgotten(num_shared):
    world = thinned_world(num_shared, step_sd=0.0003, growth=1.0)
    before = np.abs(way_errors(world)).max()
    assert adjust_whole_map(world, CAMERA, NOISE) == 18
    assert np.abs(way_errors(world)).max() < max(0.01, 2.0 * before)


@pytest.mark.parametrize(("gaps", "num_adjusted"), [(set(), 18), ({310}, 16), ({340}, 17)])
def test_keyframes_that_share_no_landmark_hang_together_by_a_step_but_not_over_a_gap(gaps, num_adjusted):
    world = thinned_world(30)  # the last three share none
    world.gaps = gaps
    assert adjust_whole_map(world, CAMERA, NOISE) == num_adjusted


def test_steps_of_a_part_are_in_the_unit_that_the_part_before_left_it_in():
    cut, first = 14, {}

    def sees(k, ids):
        mine = ids[(ids % 2 == 0) == (k < cut)]
        return np.array(
            [n for n in mine.tolist() if k < cut or k // 2 - first.setdefault(n, k // 2) <= 1], np.int64
        )

    world, _ = drifted_world(sees, step_sd=0.0003, growth=1.02)
    world.keyframes = world.keyframes[:cut] + world.keyframes[cut::2]
    world.gaps = {10 * cut}
    before = way_errors(world)[cut:]
    assert adjust_whole_map(world, CAMERA, NOISE) == cut + 11
    grown = (1.0 + way_errors(world)[cut:]) / (1.0 + before)
    assert grown.mean() < 0.9, "else its unit is the old one"
    np.testing.assert_allclose(grown, grown.mean(), rtol=0.01)


def test_a_map_larger_than_the_limit_is_adjusted_by_a_part_of_its_landmarks(monkeypatch):
    monkeypatch.setattr(whole_map, "MAX_OBSERVATIONS", 3000)
    monkeypatch.setattr(whole_map, "OBSERVATIONS_EACH", 0)
    world, points = drifted_world()
    assert sum(len(k.ids) for k in world.keyframes) > 5000
    before, points_before = errors_m(world).max(), median_error_m(world, points)
    assert adjust_whole_map(world, CAMERA, NOISE) == NUM_KEYFRAMES
    assert errors_m(world).max() < 0.3 * before
    # Those left out follow the keyframe that made them.
    assert median_error_m(world, points) < 0.6 * points_before


@pytest.mark.parametrize("num_keyframes", [0, 1, 4])
def test_too_small_a_map_stays_as_it_is(num_keyframes):
    world, _ = drifted_world()
    del world.keyframes[num_keyframes:]
    places = {k: T.copy() for k, T in world.poses.items()}
    assert adjust_whole_map(world, CAMERA, NOISE) == 0
    assert all(np.array_equal(world.poses[k], T) for k, T in places.items())


def test_a_map_that_can_not_be_adjusted_stays_as_it_is(monkeypatch):
    world, _ = drifted_world()
    for k in world.keyframes[1:]:
        k.T_world_cam[:] = np.nan
    xyz = world.landmarks.xyz.copy()
    assert adjust_whole_map(world, CAMERA, NOISE) == 0
    np.testing.assert_array_equal(world.landmarks.xyz, xyz)


def test_a_part_within_the_time_of_another_one_does_not_tear_that_apart():
    """The camera left, the keyframes between went, and it came back: the way back is not bent again."""
    out, back = 12, 26
    world, _ = drifted_world(lambda k, ids: ids[ids % 2 == (out <= k < back)])
    before = errors_m(world)[back:].max()
    assert adjust_whole_map(world, CAMERA, NOISE) == NUM_KEYFRAMES
    assert before > 0.1
    assert errors_m(world)[back:].max() < 0.2 * before
    for k in (out, back, NUM_KEYFRAMES - 1):
        np.testing.assert_allclose(world.pose_of_frame(10 * k), world.keyframes[k].T_world_cam, atol=1e-12)


def test_a_map_of_too_many_keyframes_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(whole_map, "MAX_KEYFRAMES", NUM_KEYFRAMES - 1)
    world, _ = drifted_world()
    places = {k: T.copy() for k, T in world.poses.items()}
    assert adjust_whole_map(world, CAMERA, NOISE) == 0
    assert all(np.array_equal(world.poses[k], T) for k, T in places.items())


def test_each_keyframe_keeps_observations_enough_where_there_are_many(monkeypatch):
    """Of many keyframes with few observations each, the limit alone would let every one go astray."""

    def steps(world):
        T_world_cam = np.stack([k.T_world_cam for k in world.keyframes])
        T_true = np.stack([true_pose(k) for k in range(NUM_KEYFRAMES)])
        error = (invert_transform(T_world_cam[:-1]) @ T_world_cam[1:])[:, :3, 3]
        error -= (invert_transform(T_true[:-1]) @ T_true[1:])[:, :3, 3]
        return np.median(np.linalg.norm(error, axis=1))

    monkeypatch.setattr(whole_map, "MAX_OBSERVATIONS", 200)
    world, _ = drifted_world()
    before = steps(world)
    assert adjust_whole_map(world, CAMERA, NOISE) == NUM_KEYFRAMES
    assert steps(world) < before


def test_a_part_that_can_not_be_adjusted_is_tried_once(monkeypatch):
    """Nothing has changed since, so a second try would end as the first."""
    world, _ = drifted_world()
    asked = []

    def in_vain(problem):
        asked.append(problem)
        return replace(optimise(replace(problem, iterations=1)), ok=False)

    monkeypatch.setattr(whole_map, "optimise", in_vain)
    assert adjust_whole_map(world, CAMERA, NOISE) == 0
    assert len(asked) == 1
