import math

import numpy as np
import pytest
from scipy import ndimage

from semcast.evaluation.image_quality import ms_ssim, ssim


@pytest.fixture
def pair(rng):
    a = ndimage.gaussian_filter(rng.uniform(0, 255, (180, 200, 3)), (3, 3, 0)) * 4 - 380
    a = np.clip(a, 0, 255).astype(np.uint8)
    b = np.clip(a.astype(float) + rng.normal(0, 12, a.shape), 0, 255).astype(np.uint8)
    return a, b


def window():
    x = np.arange(-5, 6)
    g = np.exp(-(x**2) / (2 * 1.5**2))
    return np.outer(g, g) / g.sum() ** 2


def reference_parts(x, y):
    """SSIM and its contrast-structure part of one channel by the definition, with scipy."""
    w = window()

    def mean(z):
        return ndimage.correlate(z, w)[5:-5, 5:-5]

    mx, my = mean(x), mean(y)
    vx, vy, cxy = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    cs = (2 * cxy + 0.03**2) / (vx + vy + 0.03**2)
    return np.mean((2 * mx * my + 0.01**2) / (mx**2 + my**2 + 0.01**2) * cs), np.mean(cs)


def test_ssim_meets_the_definition_written_with_scipy(pair):
    a, b = pair
    expected = np.mean([reference_parts(a[..., c] / 255, b[..., c] / 255)[0] for c in range(3)])
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)


def test_ms_ssim_meets_the_definition_written_with_scipy(pair):
    a, b = pair
    expected = []
    for c in range(3):
        x, y, product = a[..., c] / 255, b[..., c] / 255, 1.0
        for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
            whole, cs = reference_parts(x, y)
            product *= (whole if scale == 4 else cs) ** weight
            h, w = x.shape[0] // 2, x.shape[1] // 2
            x, y = (z[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean(axis=(1, 3)) for z in (x, y))
        expected.append(product)
    assert ms_ssim(a, b) == pytest.approx(np.mean(expected), abs=1e-6)


def test_ssim_of_flat_images_by_hand():
    # No structure: only the luminance term (2 m n + C1) / (m^2 + n^2 + C1) is left.
    a, b = np.full((16, 16, 3), 51, np.uint8), np.full((16, 16, 3), 102, np.uint8)
    assert ssim(a, b) == pytest.approx((2 * 0.2 * 0.4 + 1e-4) / (0.04 + 0.16 + 1e-4), rel=1e-6)


def test_equal_images_are_alike_and_noise_makes_them_less_so(pair, rng):
    a, b = pair
    assert ssim(a, a) == pytest.approx(1.0)
    assert ms_ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, b) == pytest.approx(ssim(b, a))
    worse = np.clip(a.astype(float) + rng.normal(0, 40, a.shape), 0, 255).astype(np.uint8)
    assert ssim(a, worse) < ssim(a, b) < 1
    assert ms_ssim(a, worse) < ms_ssim(a, b) < 1


def test_an_image_and_its_negative_stay_finite(pair):
    a, _ = pair
    assert ssim(a, 255 - a) < 0
    assert math.isfinite(ms_ssim(a, 255 - a))


def test_images_that_the_window_does_not_fit_have_no_similarity(pair):
    a, b = pair
    for similarity, least in ((ssim, 11), (ms_ssim, 176)):
        assert similarity(a[: least - 1], b[: least - 1]) is None
        assert similarity(a[:least], b[:least]) is not None


def test_bad_images_are_named():
    with pytest.raises(ValueError, match="images must be uint8, got float64"):
        ssim(np.zeros((20, 20, 3)), np.zeros((20, 20, 3)))
    with pytest.raises(ValueError, match="same shape"):
        ssim(np.zeros((20, 20, 3), np.uint8), np.zeros((20, 21, 3), np.uint8))
