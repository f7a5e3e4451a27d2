"""How a camera turned, told by whole images."""

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, log_so3, rotation_angle_deg
from semcast.server.geometry.turning import turn_between

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
K = np.array([[260, 0, 159.5], [0, 260, 119.5], [0, 0, 1.0]])
STAYED = np.zeros(3)


def scene(seed=0, shape=(7, 9)):
    """A few large bright and dark patches: edges and shades, hardly a corner."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(60, 190, shape).astype(np.float32)
    return cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)


def wall(R_cam_wall, t_cam_wall, seed=0, shape=(7, 9)):
    """What a camera sees of a wall at unit depth in front of where it began, ``(240, 320)`` grey levels."""
    K_wall = np.array([[260, 0, 319.5], [0, 260, 239.5], [0, 0, 1.0]])
    plane = R_cam_wall + np.outer(t_cam_wall, (0, 0, 1.0))
    H = K @ plane @ np.linalg.inv(K_wall)
    return np.clip(cv2.warpPerspective(scene(seed, shape), H, (320, 240)), 0, 255)


def noisy(image, seed, gain=1.0):
    rng = np.random.default_rng(seed)
    return np.clip(gain * image + rng.normal(0, 4.0, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (0, 6, 0), (4, -3, 2)])
def test_a_turn_is_told_by_images_without_corners(turn_deg):
    R = exp_so3(np.radians(turn_deg))
    found = turn_between(CAMERA, noisy(wall(np.eye(3), STAYED), 1), noisy(wall(R, STAYED), 2), STAYED)
    assert rotation_angle_deg(found.T @ R) < 0.15


@pytest.mark.parametrize("deg", [-17.0, 17.0])
def test_a_turn_out_of_reach_is_told_from_where_it_is_expected(deg):
    """Where it is expected wrongly, the search begins from no turn as well."""
    R, small = exp_so3((0, np.radians(deg), 0)), exp_so3((0.02, -0.03, 0.01))
    before, now, hardly = (
        noisy(wall(turn, STAYED, shape=(21, 27)), seed) for seed, turn in enumerate((np.eye(3), R, small), 1)
    )
    expected = exp_so3((0, np.radians(0.8 * deg), 0))
    alone = turn_between(CAMERA, before, now, STAYED)
    assert alone is None or rotation_angle_deg(alone.T @ R) > 5.0
    assert rotation_angle_deg(turn_between(CAMERA, before, now, STAYED, expected).T @ R) < 0.15
    assert rotation_angle_deg(turn_between(CAMERA, before, hardly, STAYED, expected).T @ small) < 0.15


def test_a_strip_whose_height_is_rounded_tells_as_much():
    rows = slice(85, 155)  # a width of 80 would make it 17.5 pixels high
    strip = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5 - rows.start, width=320, height=70)
    R = exp_so3(np.radians((2, 0, 0)))
    before, now = (np.rint(wall(turn, STAYED)[rows]).astype(np.uint8) for turn in (np.eye(3), R))
    up_deg = np.degrees(log_so3(turn_between(strip, before, now, STAYED)))[0]
    assert up_deg == pytest.approx(2.0, abs=0.06)


def test_an_image_of_any_shape_tells():
    columns = slice(140, 180)  # a width of 80 makes it 480 pixels high
    upright = Intrinsics(fx=260, fy=260, cx=159.5 - columns.start, cy=119.5, width=40, height=240)
    R = exp_so3(np.radians((2, 0, 0)))
    before, now = (np.rint(wall(turn, STAYED)[:, columns]).astype(np.uint8) for turn in (np.eye(3), R))
    up_deg = np.degrees(log_so3(turn_between(upright, before, now, STAYED)))[0]
    assert up_deg == pytest.approx(2.0, abs=0.06)


def test_brightness_may_change():
    R = exp_so3((0, 0.08, 0))
    before, now = noisy(wall(np.eye(3), STAYED), 1), noisy(wall(R, STAYED) + 15.0, 2)
    assert rotation_angle_deg(turn_between(CAMERA, before, now, STAYED).T @ R) < 0.3


def test_a_thing_in_another_light_does_not_turn_the_camera():
    R = exp_so3((0, 0.05, 0))
    brighter = wall(R, STAYED) + 20.0
    brighter[60:100, 100:180] = 230.0
    found = turn_between(CAMERA, noisy(wall(np.eye(3), STAYED), 1), noisy(brighter, 2), STAYED)
    assert rotation_angle_deg(found.T @ R) < 0.15


def test_stripes_and_views_with_little_in_common_tell_no_turn():
    upright = np.tile(scene().mean(axis=0, dtype=np.float32), (480, 1))[120:360, 160:480]
    stripes = np.rint(upright).astype(np.uint8)
    assert turn_between(CAMERA, stripes, stripes, STAYED) is None, "none about the axis across them"
    way = np.array([0.9, 0.0, 0.0])  # of 320 pixels 86 are in both
    before, now = noisy(wall(np.eye(3), STAYED), 1), noisy(wall(np.eye(3), -way), 2)
    assert turn_between(CAMERA, before, now, way) is None


def test_what_moving_does_is_no_turn():
    R, way = exp_so3((0, 0.05, 0)), np.array([0.08, 0.0, 0.05])
    before, now = noisy(wall(np.eye(3), STAYED), 1), noisy(wall(R, -R @ way), 2)
    assert rotation_angle_deg(turn_between(CAMERA, before, now, way).T @ R) < 0.2
    assert rotation_angle_deg(turn_between(CAMERA, before, now, STAYED).T @ R) > 2.0


def test_another_view_and_one_that_shows_nothing_tell_no_turn():
    before = noisy(wall(np.eye(3), STAYED), 1)
    assert turn_between(CAMERA, before, noisy(wall(np.eye(3), STAYED, seed=5), 2), STAYED) is None
    even = np.full((240, 320), 120, np.uint8)
    assert turn_between(CAMERA, even, even, STAYED) is None
