"""Frames that come several at once, and whether their times are to be believed."""

import numpy as np
import pytest

from semcast.common.geometry import exp_se3
from semcast.server.geometry.bunches import Bunches, in_bunches
from semcast.server.geometry.motion import ConstantVelocity

PERIOD_S = 0.1
#: Turn and way of a camera from frame to frame.
TWIST = np.array([0.0, 0.02, 0.01, 0.1, 0.0, 0.3])


def waiting(size, num=12):
    """Intervals between frames that a network holds back and lets go, ``size`` at once."""
    return [0.002 if k % size else size * PERIOD_S - 0.002 * (size - 1) for k in range(1, num + 1)]


def noted(intervals_s, twists):
    bunches = Bunches()
    for interval_s, twist in zip(intervals_s, twists, strict=True):
        bunches.note(interval_s, exp_se3(twist))
    return bunches


@pytest.mark.parametrize("size", [2, 3, 5, 9])
def test_times_mislead_where_frames_waited_for_each_other(size):
    intervals_s = waiting(size, num=24)
    rng = np.random.default_rng(size)
    twists = TWIST * rng.normal(1.0, 0.2, (24, 6))
    assert in_bunches(intervals_s)
    assert noted(intervals_s, twists).mislead


@pytest.mark.parametrize("size", [2, 3, 5])
def test_times_are_believed_where_images_were_taken_in_bunches(size):
    intervals_s = [0.02 if k % size else 0.3 for k in range(1, 13)]
    rng = np.random.default_rng(size)
    twists = [TWIST * s / PERIOD_S * rng.normal(1.0, 0.2, 6) + rng.normal(0, 1e-3, 6) for s in intervals_s]
    assert in_bunches(intervals_s)
    assert not noted(intervals_s, twists).mislead


def test_a_hand_that_turns_on_the_spot_tells_by_its_turns():
    turns = np.concatenate([TWIST[:3], np.zeros(3)]) * np.ones((12, 1))
    assert noted(waiting(3), turns).mislead
    taken_s = [0.02, 0.02, 0.3] * 4
    assert not noted(taken_s, [turns[0] * s / PERIOD_S for s in taken_s]).mislead


@pytest.mark.parametrize(
    "intervals_s",
    [[PERIOD_S] * 12, [PERIOD_S, 2 * PERIOD_S, 5 * PERIOD_S] * 4, [PERIOD_S] * 11 + [1.5], [PERIOD_S]],
    ids=["regular", "half lost", "a gap", "one"],
)
def test_regular_and_lost_frames_come_in_no_bunches(intervals_s):
    assert not in_bunches(intervals_s)
    alike = noted(intervals_s, [TWIST] * len(intervals_s))
    assert not alike.mislead, "steps are alike, but nothing is wrong with the times"


def test_only_the_last_steps_count():
    bunches = noted(waiting(3), [TWIST] * 12)
    # Of 24; it takes two waits, and the last but one is the ninth of the twelve.
    for _ in range(20):
        assert bunches.mislead
        bunches.note(PERIOD_S, exp_se3(TWIST))
    bunches.note(PERIOD_S, exp_se3(TWIST))
    assert not bunches.mislead


def test_a_camera_that_hung_once_has_gone_on():
    times_s = [PERIOD_S] * 3 + [2.5] + [PERIOD_S] * 3
    assert in_bunches(times_s)
    assert not noted(times_s, [TWIST] * 7).mislead, "though one step is like the others"


def test_frames_of_one_time_are_a_bunch():
    assert noted([0.0, 0.0, 0.3] * 3, [TWIST] * 9).mislead


def test_a_step_over_missing_frames_counts_as_one_of_each_of_them():
    bunches = noted([PERIOD_S] * 11, [TWIST] * 11)
    # Nearer than the speed led: what comes after a gap looks like a bunch but for the frames in between.
    bunches.note(30 * PERIOD_S, exp_se3(10 * TWIST), num_frames=30)
    assert not bunches.mislead
    np.testing.assert_allclose(bunches.last, exp_se3(TWIST / 3), atol=0.02)


def test_the_last_step_is_told_in_another_unit():
    bunches = noted(waiting(3), [TWIST] * 12)
    bunches.rescale(2.0)
    np.testing.assert_allclose(bunches.last[:3, 3], 2.0 * exp_se3(TWIST)[:3, 3])
    assert Bunches().last is None


@pytest.mark.parametrize("misleads", [False, True])
def test_turning_is_told_over_a_second_where_times_mislead(misleads):
    motion = ConstantVelocity()
    t_ns, T = 1_000_000_000, np.eye(4)
    motion.observe(t_ns, T)
    for interval_s in waiting(3, num=13):
        t_ns, T = t_ns + round(interval_s * 1e9), T @ exp_se3(TWIST)
        motion.observe(t_ns, T)
    motion.times_mislead = misleads
    true_rad = np.linalg.norm(TWIST[:3]) / PERIOD_S
    told_rad = np.arccos((np.trace(motion.turn_in(0.1)) - 1.0) / 2.0) / 0.1
    assert (told_rad == pytest.approx(true_rad, rel=0.3)) == misleads
