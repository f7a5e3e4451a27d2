"""What a camera that went steadily can't have done from one frame to the next."""

import numpy as np
import pytest

from semcast.common.geometry import exp_so3, make_transform
from semcast.server.geometry.jump import is_jump

FRAME_S = 1.0 / 15.0


def steps_of(ways, took_s=FRAME_S):
    """Steps by the ways of a camera that doesn't turn."""
    return [(took_s, make_transform(np.eye(3), way), np.asarray(way)) for way in ways]


def walk(num, seed=0, sway=0.02):
    """Steps of one unit ahead that sway."""
    rng = np.random.default_rng(seed)
    return steps_of(np.array([0.0, 0.0, 1.0]) + sway * rng.normal(size=(num, 3)))


def step(length, sideways=0.0):
    return make_transform(np.eye(3), (sideways, 0.0, length))


@pytest.mark.parametrize("found", [step(0.4), step(1.7), step(0.9, sideways=0.6)])
def test_half_a_step_off_is_a_jump(found):
    assert is_jump(walk(30), FRAME_S, found)


@pytest.mark.parametrize("found", [step(0.7), step(1.3), step(1.0, sideways=-0.3)])
def test_a_little_faster_or_slower_is_none(found):
    assert not is_jump(walk(30), FRAME_S, found)


def test_turning_into_a_corridor_is_none():
    turned = make_transform(exp_so3((0.0, np.radians(15.0), 0.0)), (0.1, 0.0, 1.0))
    assert not is_jump(walk(30), FRAME_S, turned)


def test_what_is_usual_of_a_camera_that_shakes_is_none():
    shaken = walk(30, sway=0.15)
    assert not is_jump(shaken, FRAME_S, step(0.45))
    assert is_jump(walk(30), FRAME_S, step(0.45)), "it is of one that doesn't"


def test_a_hand_that_waves_can_turn_back_at_once():
    waved = steps_of([(np.sin(k / 3.0), 0.0, 0.0) for k in range(30)])
    assert not is_jump(waved, FRAME_S, make_transform(np.eye(3), (2.0, 0.0, 0.0)))


def test_nothing_is_known_of_a_longer_step_or_after_few():
    assert not is_jump(walk(30), 2.0 * FRAME_S, step(0.4))
    assert not is_jump(walk(10), FRAME_S, step(0.4))
    assert not is_jump([], FRAME_S, step(0.4))


def test_a_camera_at_rest_can_set_off():
    assert not is_jump(steps_of(np.zeros((30, 3))), FRAME_S, step(1.0))
