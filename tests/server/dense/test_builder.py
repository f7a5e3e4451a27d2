"""Whose depth is estimated from which neighbours, and what of it becomes points."""

import time

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, transform_points
from semcast.server.dense.builder import DenseBuilder
from semcast.server.dense.depth_map import DepthMap
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=60.0, fy=60.0, cx=39.5, cy=29.5, width=80, height=60)
#: Everything is a wall at this distance from the line the camera moves along.
WALL = 5.0
STEP_M = 0.3


class Wall:
    """Says at once that all is a wall, or, as told, nothing; holds results back while it is ``slow``."""

    def __init__(self, depth_of=lambda frame_id: WALL):
        self.asked = []
        self.slow = False
        self.unit = 1.0
        self.closed = False
        self._depth_of = depth_of
        self._result = None

    @property
    def busy(self):
        return self._result is not None

    def submit(self, problem):
        assert not self.busy
        self.asked.append(problem)
        frame_id = problem.reference.frame_id
        inverse = np.full(
            problem.reference.shape_hw, 1.0 / (self.unit * self._depth_of(frame_id)), np.float32
        )
        self._result = DepthMap(frame_id, inverse, 0.002)
        return True

    def take(self, wait=False):
        if self.slow and not wait:
            return None
        result, self._result = self._result, None
        return result

    def close(self):
        self.closed = True

    @property
    def asked_ids(self):
        return [problem.reference.frame_id for problem in self.asked]


def add_keyframe(world, builder, k, *, x_m=None, turn_deg=0.0, submap=0, num_landmarks=30):
    """A keyframe ``k`` steps along the wall, 255 * its number bright, and landmarks on the wall before it."""
    x_m = k * STEP_M if x_m is None else x_m
    T_world_cam = make_transform(exp_so3((0.0, np.radians(turn_deg), 0.0)), (x_m, 0.0, 0.0))
    ids = np.arange(num_landmarks) + 1000 * k
    xy = np.random.default_rng(k).uniform((2, 2), (78, 58), (num_landmarks, 2))
    rays = np.column_stack([(xy - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, np.ones(num_landmarks)])
    ones, colours = np.ones(num_landmarks), np.zeros((num_landmarks, 3), np.uint8)
    world.add_keyframe(Keyframe(k, k, T_world_cam, submap, ids, xy, ones))
    world.add_landmarks(ids, transform_points(T_world_cam, WALL * rays), colours, ones, submap, k)
    image = np.full((60, 80, 3), 10 + k, np.uint8)
    builder.add_keyframe(k, image, np.full((60, 80), 0.25, np.float32))


def run(num=8, runner=None, lossless=True, at_end=False, **how):
    runner = Wall() if runner is None else runner
    world, builder = WorldMap(), DenseBuilder(CAMERA, runner, lossless=lossless, at_end=at_end)
    for k in range(num):
        add_keyframe(world, builder, k, **how)
        builder.advance(world)
    return world, builder, runner


def finish(builder, world, **how):
    """What the end of a stream adds."""
    return [patch for patches in builder.finish(world, **how) for patch in patches]


def neighbours(problem):
    return [[n.view.frame_id for n in group] for group in problem.groups]


def test_every_keyframe_gets_its_depth_from_both_sides():
    world, builder, runner = run(6)
    assert runner.asked_ids == [0, 1, 2, 3]
    assert [neighbours(p) for p in runner.asked] == [
        [[1, 2]],
        [[0], [2, 3]],
        [[1, 0], [3, 4]],
        [[2, 1], [4, 5]],
    ]
    finish(builder, world)
    assert runner.asked_ids == [0, 1, 2, 3, 4, 5]
    assert neighbours(runner.asked[-1]) == [[4, 3]]


def test_depth_is_sought_around_that_of_the_landmarks():
    _, _, runner = run(3)
    assert 0.5 * WALL < runner.asked[0].nearest < WALL < runner.asked[0].farthest < 2.0 * WALL


def test_poses_of_neighbours_are_relative_to_the_keyframe():
    _, _, runner = run(4)
    T_nbr_ref = runner.asked[1].groups[0][0].T_nbr_ref
    np.testing.assert_allclose(T_nbr_ref, make_transform(np.eye(3), (STEP_M, 0.0, 0.0)))


def test_neighbours_that_hardly_moved_are_passed_over():
    world, runner = WorldMap(), Wall()
    builder = DenseBuilder(CAMERA, runner, lossless=True)
    for k, x_m in enumerate((0.0, 0.01, 0.02, 0.3, 0.6)):
        add_keyframe(world, builder, k, x_m=x_m)
    builder.advance(world)
    assert neighbours(runner.asked[0]) == [[3, 4]]


def test_views_turned_far_away_and_of_other_parts_are_no_neighbours():
    world, runner = WorldMap(), Wall()
    builder = DenseBuilder(CAMERA, runner, lossless=True)
    for k, (turn_deg, submap) in enumerate(((0.0, 0), (60.0, 0), (0.0, 1), (0.0, 1), (0.0, 1))):
        add_keyframe(world, builder, k, turn_deg=turn_deg, submap=submap)
    finish(builder, world)
    assert runner.asked_ids == [2, 3, 4], "the first two see nothing that another one sees"
    assert all(k > 1 for p in runner.asked for group in neighbours(p) for k in group)


def test_keyframes_with_too_few_landmarks_are_left_out():
    world, builder, runner = run(5, num_landmarks=5)
    finish(builder, world)
    assert runner.asked == []


def test_the_cloud_is_the_wall_and_each_part_of_it_once():
    world, builder, _ = run(8)
    finish(builder, world)
    points = builder.points(world)
    np.testing.assert_allclose(points.xyz[:, 2], WALL, rtol=1e-5)
    width_m = 80 / 60 * WALL + 7 * STEP_M - 4 * STEP_M  # what only the first or last two see is not sure
    assert np.ptp(points.xyz[:, 0]) == pytest.approx(width_m, rel=0.03)
    in_all = len(points.xyz) / (80 * 60)
    assert 1.1 < in_all < 1.0 + 7 * STEP_M / (80 / 60 * WALL) + 0.15, "what was seen before adds nothing"
    assert np.all(points.confidence == np.float32(0.25))
    assert set(points.rgb[:, 0].tolist()) <= set(range(10, 18))


def test_depth_that_nobody_confirms_makes_no_points():
    world, builder, _ = run(8, Wall(lambda frame_id: WALL if frame_id != 3 else 0.5 * WALL))
    assert {p.frame_id for p in finish(builder, world)}.isdisjoint({3})
    np.testing.assert_allclose(builder.points(world).xyz[:, 2], WALL, rtol=1e-5)


def test_a_live_cloud_waits_for_nobody_and_leaves_out_what_is_too_much():
    runner = Wall()
    runner.slow = True
    world, builder, _ = run(9, runner, lossless=False)
    assert runner.asked_ids == [0], "it is still at work on it"
    runner.slow = False
    builder.advance(world)
    assert runner.asked_ids == [0, 5], "of those that wait the newest two stay"
    assert finish(builder, world, budget_s=0.0) == [], "nothing confirms the only depth there is"
    assert runner.asked_ids == [0, 5], "another stream waits"
    finish(builder, world)
    assert runner.asked_ids == [0, 5, 6, 7, 8]


def test_a_cloud_at_the_end_waits_for_it_and_is_the_same():
    world, builder, runner = run(8)
    finish(builder, world)
    late = Wall()
    late_world, late_builder, _ = run(8, late, at_end=True)
    assert late.asked == []
    assert late_builder.num_waiting == 8
    assert {p.frame_id for p in finish(late_builder, late_world)} == {0, 1, 2, 3, 4, 5}
    assert late.asked_ids == runner.asked_ids
    assert late_builder.points(late_world).xyz.tolist() == builder.points(world).xyz.tolist()


def test_images_for_the_end_are_those_of_keyframes_that_the_map_keeps(monkeypatch):
    monkeypatch.setattr("semcast.server.dense.builder._NUM_STORED", 30)
    runner = Wall()
    world, builder = WorldMap(), DenseBuilder(CAMERA, runner, at_end=True)
    for k in range(60):
        add_keyframe(world, builder, k)
        world.bound(10_000, max_keyframes=20, recent=5)
        builder.advance(world)
    assert builder.num_waiting <= 30
    finish(builder, world)
    assert runner.asked_ids == [keyframe.frame_id for keyframe in world.keyframes]
    assert len(runner.asked_ids) > 10


def test_images_for_the_end_are_bounded(monkeypatch):
    monkeypatch.setattr("semcast.server.dense.builder._NUM_STORED", 10)
    world, builder, runner = run(40, at_end=True)
    finish(builder, world)
    assert 5 <= len(runner.asked) <= 10
    assert np.ptp(runner.asked_ids) > 30


def test_a_keyframe_that_lost_its_pose_is_left_out():
    world, runner = WorldMap(), Wall()
    builder = DenseBuilder(CAMERA, runner, lossless=True)
    for k in range(6):
        add_keyframe(world, builder, k)
    world.forget_frames([2])
    finish(builder, world)
    assert 2 not in runner.asked_ids
    assert all(2 not in group for p in runner.asked for group in neighbours(p))


def test_a_new_map_has_a_new_cloud_and_does_not_wait_for_the_old_one():
    runner = Wall()
    runner.slow = True
    world, builder, _ = run(6, runner, lossless=False)
    builder.reset()
    assert runner.busy
    assert len(builder.points(world).xyz) == 0
    runner.slow = False
    assert finish(builder, world) == []
    assert runner.asked_ids == [0], "what was under way is of a map that is gone"
    builder.close()
    assert runner.closed


@pytest.mark.parametrize("scale", [2.0, 0.5])
def test_depth_in_units_of_before_a_join_makes_no_points_after_it(scale):
    """What is left over from before, or under way, is as far away as the wall was then."""
    world, builder, runner = run(8, submap=1)
    finish(builder, world)
    for k in range(8, 12):
        add_keyframe(world, builder, k, submap=1)
        builder.advance(world)
    world.transform_submap(1, 0, scale, np.eye(4))
    runner.unit = scale
    builder.follow(world, list(range(12)))
    finish(builder, world)
    np.testing.assert_allclose(builder.points(world).xyz[:, 2], scale * WALL, rtol=1e-4)


def test_the_end_of_a_stream_waits_no_longer_than_it_may():
    runner = Wall()
    runner.slow = True
    world, builder, _ = run(8, runner, at_end=True)
    since_s = time.monotonic()
    finish(builder, world, budget_s=0.1)
    assert 0.1 <= time.monotonic() - since_s < 30.0
    assert runner.asked_ids == [0]
