"""The dense cloud hangs on the map's keyframes."""

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, transform_points
from semcast.server.dense.cloud import DenseCloud, DensePatch, landmark_depths
from semcast.server.mapping.world_map import Keyframe, WorldMap

NUM_LANDMARKS = 40


def patch(frame_id, num=10, seed=0):
    rng = np.random.default_rng(seed + frame_id)
    xyz = rng.uniform((-1, -1, 2), (1, 1, 6), (num, 3)).astype(np.float32)
    return DensePatch(
        frame_id, xyz, rng.integers(0, 256, (num, 3), dtype=np.uint8), np.full(num, 0.5, np.float32)
    )


def make_world(frame_ids=(0, 10), submap=0, world=None):
    """Keyframes that all see landmarks of their own, 2 to 6 away."""
    world = WorldMap() if world is None else world
    for k in frame_ids:
        ids = np.arange(NUM_LANDMARKS) + 1000 * k
        T_world_cam = exp_se3(0.1 * np.random.default_rng(k).normal(size=6))
        xy, ones = np.zeros((NUM_LANDMARKS, 2)), np.ones(NUM_LANDMARKS)
        black = np.zeros((NUM_LANDMARKS, 3), np.uint8)
        world.add_keyframe(Keyframe(k, k, T_world_cam, submap, ids, xy, ones))
        xyz = np.random.default_rng(k).uniform((-1, -1, 2), (1, 1, 6), (NUM_LANDMARKS, 3))
        world.add_landmarks(ids, transform_points(T_world_cam, xyz), black, ones, submap, k)
    return world


def cloud_of(world, **how):
    cloud = DenseCloud(**how)
    for keyframe in world.keyframes:
        cloud.add(patch(keyframe.frame_id), *landmark_depths(world, keyframe))
    return cloud


def test_points_are_where_their_keyframe_is_now():
    world = make_world()
    cloud = cloud_of(world)
    world.move_keyframe(10, exp_se3(np.full(6, 0.2)))
    points = cloud.points(world)
    for rows, frame_id in ((slice(0, 10), 0), (slice(10, 20), 10)):
        expected = transform_points(world.poses[frame_id], patch(frame_id).xyz)
        np.testing.assert_allclose(points.xyz[rows], expected, atol=1e-6)
    assert points.rgb[:10].tolist() == patch(0).rgb.tolist()
    assert len(points.confidence) == len(cloud) == 20


def test_points_take_the_scale_of_a_part_that_is_joined():
    world = make_world((10,), submap=1, world=make_world((0,)))
    cloud = cloud_of(world)
    before = cloud.points(world).xyz
    cloud.take_changes()
    T_new_old = exp_se3(np.full(6, 0.3))
    world.transform_submap(1, 0, 2.5, T_new_old)
    cloud.follow(world, [0, 10])
    after = cloud.points(world).xyz
    np.testing.assert_allclose(after[:10], before[:10])
    np.testing.assert_allclose(after[10:], transform_points(T_new_old, 2.5 * before[10:]), rtol=1e-5)
    changed = cloud.take_changes()
    assert [p.frame_id for p in changed] == [10]
    assert changed[0].scale == pytest.approx(2.5)


def test_a_keyframe_whose_landmarks_are_gone_keeps_its_scale():
    world = make_world((0,))
    cloud = cloud_of(world)
    world.move_landmarks(world.landmarks.ids, 3.0 * world.landmarks.xyz)
    world.remove_landmarks(np.arange(NUM_LANDMARKS) >= 3)
    cloud.follow(world, [0])
    assert cloud.take_changes()[0].scale == 1.0


def test_changes_are_handed_out_once():
    world = make_world()
    cloud = cloud_of(world)
    assert [p.frame_id for p in cloud.take_changes()] == [0, 10]
    assert cloud.take_changes() == ()
    cloud.follow(world, [0, 10, 77])
    assert cloud.take_changes() == (), "nothing has moved"


def test_what_is_too_much_is_taken_from_the_older_half():
    world = make_world((0, 10, 20, 30))
    cloud = cloud_of(world, max_points=39)
    assert [len(p.xyz) for p in cloud.take_changes()] == [5, 5, 10, 10]
    for frame_id in range(40, 400, 10):
        cloud.add(patch(frame_id, num=9), *landmark_depths(world, world.keyframes[0]))
        assert 20 <= len(cloud) <= 39


@pytest.mark.parametrize("less", [DensePatch.thinned, DensePatch.emptied])
def test_what_is_taken_away_is_not_kept_in_memory(less):
    whole = patch(0)
    left = less(whole)
    for name in ("xyz", "rgb", "confidence"):
        assert not np.may_share_memory(getattr(left, name), getattr(whole, name))
        assert getattr(left, name).base is None


def test_what_is_thinned_to_nothing_is_handed_out_empty_and_forgotten():
    world = make_world(range(0, 400, 10))
    cloud, sizes = DenseCloud(max_points=20), {}
    for keyframe in world.keyframes:
        cloud.add(patch(keyframe.frame_id), *landmark_depths(world, keyframe))
        sizes |= {p.frame_id: len(p.xyz) for p in cloud.take_changes()}
        cloud.follow(world, [0, keyframe.frame_id])
    assert sizes[0] == 0
    assert sum(sizes.values()) == len(cloud) <= 20
    assert len(cloud._patches) == len(cloud._landmarks) <= 10
    cloud.withdraw(sizes)
    assert {len(p.xyz) for p in cloud.take_changes()} == {0}
    assert not cloud._patches
    assert not cloud._landmarks


def test_points_of_a_frame_without_a_pose_are_left_out():
    world = make_world()
    cloud = cloud_of(world)
    world.forget_frames([0])
    assert len(cloud.points(world).xyz) == 10


def test_points_go_with_the_pose_of_their_keyframe():
    world = make_world()
    cloud = cloud_of(world)
    cloud.take_changes()
    world.forget_frames([10])
    cloud.withdraw([10, 99])
    (change,) = cloud.take_changes()
    assert (change.frame_id, len(change.xyz)) == (10, 0)
    assert len(cloud.points(world).xyz) == len(cloud) == 10
    cloud.withdraw([10])
    assert cloud.take_changes() == (), "it is empty already"
