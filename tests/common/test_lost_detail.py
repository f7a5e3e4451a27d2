"""Confidence of pictures coded at a smaller size than the camera's."""

import cv2
import numpy as np

from semcast.common.codec import LABEL_SHARPNESS
from semcast.common.lost_detail import ERROR_FACTORS, confidence_at_camera, detail_at


def _stripes(period_px: int) -> np.ndarray:
    row = 128.0 + 100.0 * np.sin(2.0 * np.pi * np.arange(96) / period_px)
    return np.repeat(np.tile(row, (64, 1))[..., None], 3, axis=2).round().astype(np.uint8)


def test_scaling_takes_fine_detail_and_nothing_from_a_plane():
    assert detail_at(np.full((64, 96, 3), 70, np.uint8), 0.6).max() == 0.0
    coarse, fine = (detail_at(_stripes(period), 0.6)[16:48, 16:80].mean() for period in (32, 3))
    assert coarse < 0.02 < 0.1 < fine
    assert detail_at(_stripes(3), 0.9)[16:48, 16:80].mean() < fine


def test_errors_of_the_link_and_of_scaling_add_up():
    image = _stripes(6)
    confidence = np.full((64, 96), 0.7, np.float32)
    got = confidence_at_camera(confidence, image, 0.6)
    of_link, of_scaling = ERROR_FACTORS
    error = of_link * np.arctanh(0.3) + of_scaling * LABEL_SHARPNESS * detail_at(image, 0.6)
    np.testing.assert_allclose(got, 1.0 - np.tanh(error), atol=1e-5)


def test_confidence_never_rises_and_nothing_trusted_stays_so():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    confidence = rng.random((48, 64), dtype=np.float32)
    confidence[:4] = 0.0
    confidence[4:8] = 1.0
    got = confidence_at_camera(confidence, image, 0.5)
    assert got.dtype == np.float32
    assert np.all((got >= 0.0) & (got <= confidence))
    assert np.all(got[:4] == 0.0)
    assert np.all(got[4:8] < 0.9), "even perfect pixels have lost the detail between them"


def test_a_sharp_place_is_trusted_less_than_a_flat_one():
    image = np.full((64, 128, 3), 120, np.uint8)
    image[:, 64:] = cv2.resize(
        np.random.default_rng(1).integers(0, 256, (32, 32, 3), dtype=np.uint8), (64, 64)
    )
    got = confidence_at_camera(np.full((64, 128), 0.8, np.float32), image, 0.6)
    assert got[:, 80:].mean() < got[:, :48].mean() - 0.1
