import cv2
import numpy as np
import pytest
from textures import shifted

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, transform_points
from semcast.evaluation.match_truth import (
    displacement_from_original_px,
    epipolar_distance_px,
    track_error_px,
    track_points,
)

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)


@pytest.fixture
def texture(rng):
    noise = rng.integers(0, 256, (120, 160, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, None, 2.0)


def test_true_matches_lie_on_their_epipolar_lines(rng):
    T_cam1_cam0 = make_transform(exp_so3([0.1, -0.2, 0.05]), [1.0, 0.2, 0.3])
    points = rng.uniform([-2, -2, 4], [2, 2, 9], (50, 3))
    xy0, xy1 = CAMERA.project(points), CAMERA.project(transform_points(T_cam1_cam0, points))
    np.testing.assert_allclose(epipolar_distance_px(xy0, xy1, T_cam1_cam0, CAMERA), 0.0, atol=1e-9)


def test_epipolar_distance_by_hand():
    # sideways motion: epipolar lines are rows; 4 px off in y is 4 / sqrt(2) when both images share it
    T_cam1_cam0 = make_transform(np.eye(3), [1.0, 0.0, 0.0])
    xy0, xy1 = np.array([[100.0, 50.0], [30.0, 90.0]]), np.array([[80.0, 54.0], [10.0, 89.0]])
    distance = epipolar_distance_px(xy0, xy1, T_cam1_cam0, CAMERA)
    assert distance == pytest.approx([4 / np.sqrt(2), 1 / np.sqrt(2)])


def test_turning_alone_has_no_lines_and_all_is_infinitely_far_from_them():
    T_cam1_cam0 = make_transform(exp_so3([0.0, 0.1, 0.0]), np.zeros(3))
    xy = np.array([[100.0, 50.0], [320.0, 240.0]])
    assert epipolar_distance_px(xy, xy, T_cam1_cam0, CAMERA).tolist() == [np.inf, np.inf]


def test_points_follow_a_shift(texture):
    points = np.array([[60.0, 50.0], [100.0, 70.0]])
    moved, found = track_points(texture, shifted(texture, 3, -2), points)
    assert found.all()
    np.testing.assert_allclose(moved, points + np.array([3, -2]), atol=0.1)
    assert track_points(texture, texture, np.zeros((0, 2)))[0].shape == (0, 2)


def test_displacement_is_zero_for_the_original_and_the_shift_otherwise(texture):
    points = np.array([[60.0, 50.0], [100.0, 70.0]])
    still, found = displacement_from_original_px(texture, texture, points)
    assert found.all()
    np.testing.assert_allclose(still, 0.0, atol=1e-3)
    moved, _ = displacement_from_original_px(shifted(texture, 0.6, 0.8), texture, points)
    np.testing.assert_allclose(moved, 1.0, atol=0.15)


def test_track_error_is_the_distance_to_the_original_track(texture):
    starts = np.array([[60.0, 50.0], [100.0, 70.0]])
    error = track_error_px(starts, starts + np.array([3, 2]), texture, shifted(texture, 3, -2))
    np.testing.assert_allclose(error, 4.0, atol=0.15)
