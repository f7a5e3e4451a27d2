"""How a camera got across a gap, and whether its past tells how far off that is."""

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, exp_so3, invert_transform, log_so3, make_transform
from semcast.server.geometry.motion import ConstantVelocity

FRAME_S = 0.1


def wandering(rng, num, turn_sd=0.2, speed_sd=0.3):
    """Poses of a camera whose turn and way per second are random walks, ``*_sd`` a second."""
    root = np.sqrt(FRAME_S)
    rate, speed, T = np.zeros(3), np.array([0.0, 0.0, 1.0]), [np.eye(4)]
    for _ in range(num - 1):
        rate, speed = (v + root * sd * rng.normal(size=3) for v, sd in ((rate, turn_sd), (speed, speed_sd)))
        T.append(T[-1] @ exp_se3(FRAME_S * np.concatenate([rate, speed])))
    return T


def seen(T_world_cam):
    motion = ConstantVelocity()
    for k, T in enumerate(T_world_cam):
        motion.observe(round(k * FRAME_S * 1e9), T)
    return motion


def over_a_gap(T_world_cam, last, gap=10, later=5):
    """Squares of the turn and the place that the bridge is off by, and what was said before."""
    motion, after_ns = seen(T_world_cam[: last + 1]), round((last + gap) * FRAME_S * 1e9)
    after, then = T_world_cam[last + gap], T_world_cam[last + gap + later]
    found = motion.bridge(after_ns, invert_transform(after) @ then, later * FRAME_S)
    said = motion.bridge_variances(after_ns, later * FRAME_S)
    off = invert_transform(after) @ found
    return (log_so3(off[:3, :3]) ** 2).sum(), (off[:3, 3] ** 2).sum(), said


@pytest.mark.parametrize(("past", "within"), [(60, 1.2), (16, 1.4), (8, 1.6)], ids=["all", "half", "quarter"])
def test_the_past_tells_how_far_off_a_bridge_is(past, within):
    """Also where it is shorter than the gap twice over, which is told from shorter gaps."""
    rng, off, said = np.random.default_rng(0), [], []
    for _ in range(40):
        turn, place, told = over_a_gap(wandering(rng, past + 16), past - 1)
        off.append((turn, place))
        said.append(told)
    ratio = np.sqrt(np.mean(off, axis=0) / (3.0 * np.mean(said, axis=0)))
    assert (ratio < within).all(), ratio
    assert (ratio > 1.0 / within).all(), ratio


def test_a_shaky_hand_is_told_from_a_car():
    rng = np.random.default_rng(1)
    (_, _, calm), (_, _, shaky) = (over_a_gap(wandering(rng, 66, sd, sd), 49) for sd in (0.02, 0.4))
    assert (np.sqrt(np.divide(shaky, calm)) > 5.0).all()


def test_of_steady_motion_nothing_is_off():
    step = make_transform(exp_so3((0.0, 0.06, 0.01)), (0.1, 0.0, 0.3))
    path = [np.linalg.matrix_power(step, k) for k in range(60)]
    turn, place, said = over_a_gap(path, 40)
    assert max(turn, said[0]) < 1e-12
    assert np.sqrt(max(place, said[1])) < 0.01, "of a way of 3"


def test_places_are_told_in_the_unit_of_the_map():
    path = wandering(np.random.default_rng(2), 50)
    motion, after_ns = seen(path), round(59 * FRAME_S * 1e9)
    turn, place = motion.bridge_variances(after_ns, 0.5)
    motion.correct(path[-1], scale=3.0)
    assert motion.bridge_variances(after_ns, 0.5) == pytest.approx((turn, 9.0 * place))


@pytest.mark.parametrize("num", [0, 1, 2, 5])
def test_a_past_that_does_not_hold_a_quarter_of_the_gap_twice_tells_nothing(num):
    motion = seen(wandering(np.random.default_rng(3), 60)[:num])
    assert motion.bridge_variances(round((num + 9) * FRAME_S * 1e9), 0.5) is None


def test_a_standing_clock_tells_nothing():
    motion = ConstantVelocity()
    for _ in range(9):
        motion.observe(0, np.eye(4))
    assert motion.bridge_variances(1_000_000_000, 0.5) is None


@pytest.mark.parametrize("gap_ns", [1, 500, 1000])
def test_of_as_good_as_no_gap_next_to_no_error_is_told(rng, gap_ns):
    # A video with one stamp far ahead has times a nanosecond apart until the others have caught up.
    motion = seen(wandering(rng, 30))
    for variance in motion.bridge_variances(round(29 * FRAME_S * 1e9) + gap_ns, 0.5):
        assert 0.0 < variance < 1e-12
