"""Where a part of the map is, by what its place was guessed to be and by where the camera was after it."""

import numpy as np
import pytest

from semcast.common.geometry import (
    exp_se3,
    exp_so3,
    log_so3,
    make_transform,
    rotation_angle_deg,
)
from semcast.server.mapping.known_end import place_by_end

#: The camera went three units on and turned back.
T_FIRST_LED = make_transform(exp_so3((0.0, 2.5, 0.0)), (0.5, 0.1, 3.0))
SIGMA = (0.01, 0.02)


def moved(scale, T, T_first_cam):
    """A pose of a part that is put elsewhere, in another unit."""
    return make_transform(
        T[:3, :3] @ T_first_cam[:3, :3], T[:3, :3] @ (scale * T_first_cam[:3, 3]) + T[:3, 3]
    )


def guess(turn=0.05, place=0.05, log_scale=0.5):
    return np.diag(np.repeat((turn, place, log_scale), (3, 3, 1)) ** 2)


@pytest.mark.parametrize("scale", [0.5, 1.8])
def test_a_unit_that_was_guessed_is_told_by_how_far_the_camera_got(scale):
    T = exp_se3([0.02, -0.03, 0.01, 0.0, 0.0, 0.0])
    found = place_by_end(guess(), T_FIRST_LED, moved(scale, T, T_FIRST_LED), SIGMA, 4.0)
    assert found.scale == pytest.approx(scale, rel=0.03)
    assert rotation_angle_deg(found.T[:3, :3].T @ T[:3, :3]) < 0.2
    assert np.linalg.norm(found.T[:3, 3]) < 0.05
    # The way there is 3 units long, of which the start may be off by .09 (.05, and .02 of a depth of 4), and
    # the end by .06 (drift): a thirtieth.
    assert np.sqrt(found.covariance[6, 6]) == pytest.approx(np.hypot(0.094, 0.064) / (3.05 * scale), rel=0.4)


def test_a_part_without_a_way_keeps_its_unit():
    """The past of a camera at rest promises a gap without any error, and there is no drift."""
    T = exp_se3([0.0, 0.02, 0.0, 0.03, 0.0, 0.0])
    found = place_by_end(guess(), np.eye(4), T, (0.01, 0.0), 4.0)
    assert found.scale == pytest.approx(1.0)
    np.testing.assert_allclose(found.T, T, atol=0.001)
    assert np.sqrt(found.covariance[6, 6]) == pytest.approx(0.5, rel=0.01)


def test_without_a_guess_the_end_alone_tells_turn_and_place():
    T = exp_se3([0.3, 1.2, -0.2, 5.0, -2.0, 1.0])
    there = moved(1.0, T, T_FIRST_LED)
    found = place_by_end(None, T_FIRST_LED, there, SIGMA, 4.0)
    np.testing.assert_allclose(moved(found.scale, found.T, T_FIRST_LED), there, atol=0.02)
    assert np.sqrt(found.covariance[6, 6]) == pytest.approx(0.5, rel=0.05), "nothing tells its unit"


def test_a_place_that_the_guess_excludes_is_none():
    """A corridor that looks like the first one."""
    elsewhere = moved(1.0, exp_se3([0.0, 0.0, 0.0, 0.6, 0.0, 0.0]), T_FIRST_LED)
    assert place_by_end(guess(log_scale=0.05), T_FIRST_LED, elsewhere, SIGMA, 4.0) is None
    turned = moved(1.0, exp_se3([0.0, 0.4, 0.0, 0.0, 0.0, 0.0]), T_FIRST_LED)
    assert place_by_end(guess(), T_FIRST_LED, turned, SIGMA, 4.0) is None


def test_what_is_left_is_as_large_as_it_says(rng):
    """Squared errors of guess and end together, in what the covariance promises: 7 on average."""
    squares = []
    for _ in range(300):
        off = rng.normal(0, np.sqrt(np.diag(guess(0.03, 0.08, 0.2) + guess(0.01, 0.08, 0.01))))
        scale, T = np.exp(off[6]), make_transform(exp_so3(off[:3]), off[3:6])
        drift = 0.02 * np.linalg.norm(T_FIRST_LED[:3, 3])
        noise = rng.normal(0, np.repeat((SIGMA[0], np.hypot(SIGMA[1], drift)), 3))
        there = moved(scale, T, T_FIRST_LED)
        there[:3, :3] = exp_so3(noise[:3]) @ there[:3, :3]
        there[:3, 3] += noise[3:]
        found = place_by_end(guess(0.03, 0.08, 0.2), T_FIRST_LED, there, SIGMA, 4.0)
        if found is None:
            continue
        R, t = found.T[:3, :3], found.T[:3, 3]
        left = [log_so3(R.T @ T[:3, :3]), R.T @ (T[:3, 3] - t), [np.log(scale / found.scale)]]
        left = np.concatenate(left)
        squares.append(left @ np.linalg.solve(found.covariance, left))
    assert len(squares) > 280
    assert np.mean(squares) == pytest.approx(7.0, rel=0.15)
