import math

import numpy as np
import pytest

from semcast.common.image import psnr_db, psnr_of_mse


def test_psnr_by_hand():
    a = np.zeros((2, 2, 3), np.uint8)
    b = a.copy()
    b[0, 0, 0] = 51  # mse = 51^2 / 12
    assert psnr_db(a, b) == pytest.approx(10 * math.log10(255**2 * 12 / 51**2))
    assert psnr_db(b, a) == psnr_db(a, b)


def test_equal_images_give_100():
    assert psnr_db(np.full((4, 4), 7, np.uint8), np.full((4, 4), 7, np.uint8)) == 100.0


def test_psnr_of_an_error_is_that_of_the_images_within_100_db():
    assert psnr_of_mse(0.01) == pytest.approx(20.0)
    assert psnr_of_mse(0.01 * 255**2, 255.0) == pytest.approx(20.0)
    assert psnr_of_mse(0.0) == psnr_of_mse(1e-30) == 100.0
    assert math.isnan(psnr_of_mse(math.nan))


def test_bad_images_are_named():
    with pytest.raises(ValueError, match="images must be uint8, got float64 and uint8"):
        psnr_db(np.zeros((2, 2)), np.zeros((2, 2), np.uint8))
    with pytest.raises(ValueError, match=r"same shape, got \(2, 2\) and \(2, 3\)"):
        psnr_db(np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8))
