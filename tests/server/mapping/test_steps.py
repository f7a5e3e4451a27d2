"""What is known of the way between two keyframes, thinned out or not."""

import numpy as np
import pytest

from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.mapping.steps import steps_of
from semcast.server.mapping.world_map import Keyframe, WorldMap


def make_keyframe(frame_id, T_world_cam, ids):
    return Keyframe(frame_id, frame_id, T_world_cam, 0, ids, np.zeros((10, 2)), np.ones(10))


@pytest.mark.parametrize(
    ("num_shared", "num_steps", "gaps", "sigma", "is_gap"),
    [
        # Turned by 0.1 rad, half a unit on, points at a depth of 5.
        (8, 1, {0}, (0.002 + 0.02 * 0.1, 0.02 * 0.5 + 0.002 * 5.0, 0.01), False),
        (7, 1, {0}, (0.5, 0.5 + 5.0, 0.5), True),
        # Eight keyframes between the two were thinned out.
        (0, 9, {0, 10}, (0.006 + 0.02 * 0.1, 0.02 * 0.5 + 0.006 * 5.0, 0.03), False),
        (0, 9, {4}, (0.5, 0.5 + 5.0, 0.5), True),
        (0, 9, {9}, (0.5, 0.5 + 5.0, 0.5), True),
    ],
)
def test_how_well_a_step_is_known_by_hand(num_shared, num_steps, gaps, sigma, is_gap):
    world = WorldMap()
    before = make_transform(exp_so3([0.0, 0.0, 0.3]), [1.0, 2.0, 0.0])
    now = before @ make_transform(exp_so3([0.0, 0.0, 0.1]), [0.3, 0.4, 0.0])
    ids = np.arange(10)
    for frame_id, T, seen in ((0, before, ids + 10 - num_shared), (num_steps, now, ids)):
        world.add_keyframe(make_keyframe(frame_id, T, seen))
    world.submap_of |= dict.fromkeys(range(1, num_steps), 0) | {num_steps + 1: 1}
    world.gaps = gaps
    xyz = np.column_stack((np.arange(10.0), np.zeros(10), np.full(10, 5.0)))
    world.add_landmarks(ids, xyz, np.zeros((10, 3), np.uint8), np.ones(10), 0, 1)
    (step,) = steps_of(world, world.keyframes)
    assert (step.is_thinned, step.is_gap) == (num_steps > 1, is_gap)
    assert (step.constraint.first, step.constraint.second, step.constraint.scale) == (0, 1, 1.0)
    np.testing.assert_allclose(step.constraint.T_first_second, invert_transform(before) @ now, atol=1e-12)
    assert step.constraint.sigma == pytest.approx(sigma)


def test_drift_grows_with_the_keyframes_that_were_thinned_out_of_each_step():
    world = WorldMap()
    for frame_id in (0, 4, 13, 14):
        world.add_keyframe(make_keyframe(frame_id, np.eye(4), np.arange(10)))
    world.submap_of |= dict.fromkeys(range(15), 0)
    steps = list(steps_of(world, world.keyframes))
    assert [step.constraint.sigma[2] for step in steps] == pytest.approx([0.01 * 2, 0.01 * 3, 0.01])
    assert [step.is_thinned for step in steps] == [True, True, False]


@pytest.mark.parametrize("behind", [1, 17, 33])
def test_a_gap_stays_one_when_the_keyframes_on_both_sides_are_thinned_out(behind):
    world = WorldMap()
    for k in range(60):
        ids = np.arange(k, k + 10) + (1000 if k >= behind else 0)
        world.add_keyframe(make_keyframe(k, make_transform(np.eye(3), [0.1 * k, 0.0, 0.0]), ids))
        world.bound(max_landmarks=100, max_keyframes=20, recent=5)
    frame_ids = np.array([k.frame_id for k in world.keyframes])
    gap = np.flatnonzero([step.is_gap for step in steps_of(world, world.keyframes)])
    assert gap.tolist() == [np.searchsorted(frame_ids, behind) - 1]
    assert not np.isin([behind - 1, behind], frame_ids).all(), "else it is still seen"


def test_a_submap_that_was_joined_to_another_begins_with_a_gap():
    world = WorldMap()
    for k in range(40):
        keyframe = make_keyframe(k, np.eye(4), np.arange(k, k + 10))
        keyframe.submap = int(k >= 13)
        world.add_keyframe(keyframe)
        world.bound(max_landmarks=100, max_keyframes=20, recent=5)
    assert world.keyframe(13) is None
    world.transform_submap(1, 0, 1.0, np.eye(4))
    gaps = [
        world.keyframes[s.constraint.second].frame_id for s in steps_of(world, world.keyframes) if s.is_gap
    ]
    assert gaps == [min(k.frame_id for k in world.keyframes if k.frame_id > 13)]
