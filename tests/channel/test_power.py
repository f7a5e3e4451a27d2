import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcast.channel.power import mean_power, normalise_power


def test_mean_power_by_hand():
    assert mean_power(np.array([[3 + 4j, 0], [1j, 0]], np.complex64)) == pytest.approx(26 / 4)


@given(st.floats(1e-3, 1e3), st.integers(0, 999))
def test_normalised_symbols_have_unit_power_and_the_same_direction(scale, seed):
    pairs = np.random.default_rng(seed).standard_normal((5, 8, 2)) @ np.array([1, 1j])
    symbols = (scale * pairs).astype(np.complex64)
    out, power = normalise_power(symbols)
    assert power == mean_power(symbols)
    assert mean_power(out) == pytest.approx(1.0, rel=1e-4)
    np.testing.assert_allclose(np.angle(out), np.angle(symbols), atol=1e-4)


def test_bad_power_is_named():
    with pytest.raises(ValueError, match="must have power above 0, got 0"):
        normalise_power(np.zeros(4, np.complex64))
    with pytest.raises(ValueError, match="must be finite"):
        mean_power(np.array([np.inf], np.complex64))
    with pytest.raises(ValueError, match="must not be empty"):
        mean_power(np.zeros(0, np.complex64))
