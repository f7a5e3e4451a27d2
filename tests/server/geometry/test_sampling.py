"""Values of an image at points."""

import numpy as np

from semcast.server.geometry.sampling import bilinear, sample_map

#: Grey levels that grow by 3 to the right and by 5 downwards.
RAMP = np.add.outer(5.0 * np.arange(20), 3.0 * np.arange(30)).astype(np.float32)


def test_between_pixels_values_are_their_mean_by_distance():
    x, y = np.array([[2.0, 2.5], [7.25, 28.0]], np.float32), np.array([[4.0, 4.5], [0.0, 18.5]], np.float32)
    np.testing.assert_allclose(bilinear(RAMP, x, y), 3.0 * x + 5.0 * y, rtol=1e-6)


def test_beyond_the_border_its_values_go_on():
    x, y = np.array([[-4.0, 40.0]], np.float32), np.array([[-1.0, 25.0]], np.float32)
    np.testing.assert_allclose(bilinear(RAMP, x, y), [[0.0, 3.0 * 29 + 5.0 * 19]])


def test_there_may_be_none_and_more_than_opencv_takes_rows():
    none = np.zeros((0, 4), np.float32)
    assert bilinear(RAMP, none, none).shape == (0, 4)
    x = np.linspace(0.0, 29.0, 70_000, dtype=np.float32)[:, None]
    np.testing.assert_allclose(bilinear(RAMP, x, np.zeros_like(x)), 3.0 * x, atol=0.1)


def test_sampling_takes_the_nearest_pixel_and_counts_nan_as_nothing():
    values = np.array([[0.1, 0.2], [0.3, np.nan]], np.float32)
    xy = np.array([[0.4, 0.4], [0.6, 0.0], [-5.0, 9.0], [1.0, 1.0], [np.nan, 0.0]])
    assert np.allclose(sample_map(values, xy), [0.1, 0.2, 0.3, 0.0, 0.1])
