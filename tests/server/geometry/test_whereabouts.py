"""How far from where its motion leads a camera may be after a gap."""

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, exp_so3, make_transform
from semcast.server.geometry.motion import MAX_GAP_S, ConstantVelocity
from semcast.server.geometry.whereabouts import Whereabouts

FRAME_S = 0.1


def went(x, turn_deg=0.0):
    """Motion of a camera along x, which turns about the vertical with every frame."""
    motion = ConstantVelocity()
    for k, at in enumerate(x):
        motion.observe(round(k * FRAME_S * 1e9), at_x(at, k * turn_deg))
    return motion, round((len(x) - 1) * FRAME_S * 1e9)


def at_x(x, turn_deg=0.0):
    return make_transform(exp_so3((0.0, np.radians(turn_deg), 0.0)), (x, 0.0, 0.0))


def test_a_camera_that_went_straight_on_is_neither_back_nor_twice_as_far():
    motion, last_ns = went(0.2 * np.arange(30))
    there = motion.whereabouts(last_ns + 1_000_000_000, depth=1.0)
    assert np.isclose(there.astray(at_x(5.8 + 2.0 + 0.7)), 0.7)
    assert np.isclose(there.radius, 0.6 * 2.0)
    assert there.holds(at_x(7.8))
    assert there.holds(at_x(6.8, turn_deg=40.0)), "it stopped half-way"
    assert not there.holds(at_x(5.3))
    assert not there.holds(at_x(9.8))


def test_a_camera_that_swayed_may_be_where_swaying_leads():
    t_s = FRAME_S * np.arange(60)
    motion, last_ns = went(0.5 * np.sin(2.0 * t_s))
    there = motion.whereabouts(last_ns + 1_000_000_000, depth=1.0)
    assert there.holds(at_x(0.5 * np.sin(2.0 * (t_s[-1] + 1.0))))
    assert there.radius > 1.0


def test_a_way_bends_as_the_camera_turned_by_hand():
    there = Whereabouts(np.eye(4), np.array([0.0, 0.0, 1.0]), 0.1)
    turned = make_transform(exp_so3((0.0, np.pi / 2, 0.0)), (9.0, 9.0, 9.0))
    # A quarter of a circle as long as 1 has a radius of 2 / pi.
    led = there.turned_alike(turned)
    np.testing.assert_allclose(led, make_transform(turned[:3, :3], (2 / np.pi, 0.0, 2 / np.pi)), atol=1e-9)
    assert there.astray(led) == pytest.approx(0.0, abs=1e-9)
    straight_on = make_transform(turned[:3, :3], (0.0, 0.3, 1.0))
    assert there.astray(straight_on) == pytest.approx(0.3), "or only the camera turned"


def test_one_that_stood_may_set_off():
    motion, last_ns = went(np.zeros(30))
    there = motion.whereabouts(last_ns + 1_000_000_000, depth=4.0)
    assert np.isclose(there.radius, 0.3 * 4.0)
    assert there.holds(at_x(1.0))


def test_the_unit_of_the_map_changes_all_of_it():
    x = np.cumsum(np.random.default_rng(0).uniform(0.0, 0.4, 40))
    motion, last_ns = went(x)
    before = motion.whereabouts(last_ns + 700_000_000, depth=0.1)
    motion.correct(at_x(3.0 * x[-1]), 3.0)
    after = motion.whereabouts(last_ns + 700_000_000, depth=0.3)
    assert np.isclose(after.radius, 3.0 * before.radius)
    assert np.isclose(after.astray(at_x(3.0 * x[-1] + 3.0)), 3.0 * before.astray(at_x(x[-1] + 1.0)))


def test_what_is_long_ago_or_unknown_tells_nothing():
    motion, last_ns = went(0.2 * np.arange(30))
    assert motion.whereabouts(last_ns + round((MAX_GAP_S + 0.1) * 1e9), depth=1.0) is None
    assert motion.whereabouts(last_ns, depth=1.0) is None
    assert ConstantVelocity().whereabouts(1, depth=1.0) is None


@pytest.mark.parametrize(("num", "radius"), [(0, 0.3 * 0.5), (1, 0.6 * 2.0), (3, 0.6 * 2.0)])
def test_few_steps_tell_nothing_of_how_far_it_strays(num, radius):
    steps = [(FRAME_S, at_x(0.2), np.array([0.2, 0.0, 0.0]))] * num
    assert np.isclose(Whereabouts.after(np.eye(4), 1.0, steps, depth=0.5).radius, radius)


def test_bends_are_no_straying():
    """A robot goes straight on and turns by 90 degrees in turn, a second each; the next door is 2 m on."""
    turns = np.repeat(np.tile((0.0, np.pi / 2), 6), 10) * FRAME_S
    T_world_cam = [np.eye(4)]
    for turn in turns:
        T_world_cam.append(T_world_cam[-1] @ exp_se3((0.0, turn, 0.0, 0.0, 0.0, 1.5 * FRAME_S)))
    next_door = make_transform(np.eye(3), (0.0, 0.0, 2.0))
    motion = ConstantVelocity()
    for k, T_world_now in enumerate(T_world_cam[:-10]):
        motion.observe(round(k * FRAME_S * 1e9), T_world_now)
        if k >= 80:
            there = motion.whereabouts(round((k + 10) * FRAME_S * 1e9), depth=2.0)
            after = T_world_cam[k + 10]
            assert there.holds(after)
            assert not there.holds(after @ next_door)
            assert not there.holds(after @ np.linalg.inv(next_door))


def test_a_camera_that_looks_aside_may_have_gone_straight_on():
    motion, last_ns = went(0.2 * np.arange(30))
    there = motion.whereabouts(last_ns + 1_000_000_000, depth=1.0)
    assert np.isclose(there.astray(at_x(7.8, turn_deg=90.0)), 0.0)


def test_a_hand_that_has_just_begun_to_turn_back_may_be_far_off():
    """Half a second of what it does now is known, and it has a whole one to go on."""
    x = np.concatenate([np.zeros(20), 0.5 * (FRAME_S * np.arange(8)) ** 2])
    motion, last_ns = went(x)
    there = motion.whereabouts(last_ns + 1_000_000_000, depth=0.1)
    assert there.holds(at_x(x[-1] + 0.7 * 1.0 + 0.5))
    assert there.holds(at_x(x[-1] + 0.7 * 1.0 - 0.5))
