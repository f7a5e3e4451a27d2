"""A view keeps what the camera sees where it was, and its noise is what the confidence says."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.server.dense.view import CLEAN_SIGMA, MAX_PIXELS, error_sd, view_of

CAMERA = Intrinsics(fx=500, fy=510, cx=319.5, cy=239.5, width=640, height=480)


def square(width, height, middle_xy, half):
    image = np.zeros((height, width, 3), np.uint8)
    x, y = middle_xy
    image[y - half : y + half + 1, x - half : x + half + 1] = 255
    return image


def test_a_large_image_is_made_small_and_its_camera_with_it() -> None:
    view = view_of(3, square(640, 480, (400, 100), 12), None, CAMERA)
    height, width = view.shape_hw
    assert 0.95 * MAX_PIXELS < height * width < 1.01 * MAX_PIXELS
    y, x = np.average(np.indices((height, width)).reshape(2, -1), axis=1, weights=view.grey.ravel())
    # The ray through the middle of the square is the same one.
    assert (x - view.K[0, 2]) / view.K[0, 0] == pytest.approx((400 - 319.5) / 500, abs=5e-4)
    assert (y - view.K[1, 2]) / view.K[1, 1] == pytest.approx((100 - 239.5) / 510, abs=5e-4)


def test_a_small_image_stays_as_it_is() -> None:
    camera = Intrinsics(fx=50, fy=50, cx=31.5, cy=23.5, width=64, height=48)
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    view = view_of(0, image, None, camera)
    np.testing.assert_array_equal(view.rgb, image)
    np.testing.assert_allclose(view.K, camera.K)


def test_noise_is_that_of_the_error_which_the_confidence_stands_for() -> None:
    error = 0.05
    assert error_sd(1.0 - float(np.tanh(30 * error))) == pytest.approx(
        np.sqrt(np.pi / 2) * error * 255, rel=1e-3
    )
    assert error_sd(1.0) == pytest.approx(0.0)
    assert np.isfinite(error_sd(0.0))


def test_noise_is_that_of_most_pixels_and_never_less_than_that_of_a_clean_image() -> None:
    camera = Intrinsics(fx=50, fy=50, cx=31.5, cy=23.5, width=64, height=48)
    image = np.zeros((48, 64, 3), np.uint8)
    clean = view_of(0, image, None, camera)
    assert clean.noise == CLEAN_SIGMA
    assert (clean.confidence == 1.0).all()
    few, most = np.ones((48, 64), np.float32), np.ones((48, 64), np.float32)
    few[:, 48:] = 0.2
    most[:, 16:] = 0.2
    assert view_of(0, image, few, camera).noise == pytest.approx(CLEAN_SIGMA)
    view = view_of(0, image, most, camera)
    assert view.noise > CLEAN_SIGMA + 2
    assert view.confidence.tolist() == most.tolist()
    assert view.to_compare().confidence.size == view.to_compare().rgb.size == 0
