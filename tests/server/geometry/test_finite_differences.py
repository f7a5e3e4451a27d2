"""Derivatives by values at a few moments."""

import numpy as np
import pytest

from semcast.server.geometry.finite_differences import slope_weights


@pytest.mark.parametrize(
    "times_s", [[-0.1, 0.0, 0.1], [-0.2, -0.1, 0.0, 0.15], [0.0, -1.0], [-3.0, -1.0, 0.5]]
)
def test_a_polynomial_has_its_own_slope(times_s, rng):
    times_s = np.array(times_s)
    coefficients = rng.normal(size=len(times_s))
    values = np.polynomial.polynomial.polyval(times_s, coefficients)
    assert slope_weights(times_s) @ values == pytest.approx(coefficients[1])


def test_by_hand_two_frames_to_either_side():
    np.testing.assert_allclose(12 * slope_weights(np.arange(-2.0, 3.0)), [1, -8, 0, 8, -1], atol=1e-12)
