import math

import numpy as np
import pytest

from semcast.channel.awgn import complex_noise, noise_variance


def test_noise_variance_by_hand():
    assert noise_variance(10.0) == pytest.approx(0.1)
    assert noise_variance(-3.0) == pytest.approx(1.9953, abs=1e-4)


@pytest.mark.parametrize("snr_db", [2.0, 10.0])
def test_noise_variance_is_within_4_sigma_of_theory_in_both_parts(snr_db, rng):
    variance = noise_variance(snr_db)
    noise = complex_noise((400, 500), variance, rng)
    assert noise.dtype == np.complex64
    sigma = variance / 2 * math.sqrt(2 / noise.size)
    assert abs(np.mean(noise.real**2) - variance / 2) < 4 * sigma
    assert abs(np.mean(noise.imag**2) - variance / 2) < 4 * sigma
    assert abs(np.mean(noise)) < 4 * math.sqrt(variance / noise.size)
    assert abs(np.mean(noise.real * noise.imag)) < 4 * variance / 2 / math.sqrt(noise.size)


def test_noise_is_white_and_gaussian(rng):
    noise = complex_noise((200_000,), 2.0, rng)
    assert abs(np.mean(noise[1:] * np.conj(noise[:-1]))) < 4 * 2 / math.sqrt(noise.size)
    # Kurtosis of a Gaussian is 3, its sampling error sqrt(24 / n).
    assert abs(np.mean(noise.real**4) - 3) < 4 * math.sqrt(96 / noise.size)


def test_variance_may_differ_per_slot(rng):
    noise = complex_noise((2, 50_000), np.array([[1.0], [100.0]], np.float32), rng)
    np.testing.assert_allclose(np.mean(np.abs(noise) ** 2, axis=1), [1, 100], rtol=0.02)


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_bad_variance_is_refused(bad, rng):
    with pytest.raises(ValueError, match="noise_var must be finite and at least 0"):
        complex_noise((4,), bad, rng)
    with pytest.raises(ValueError, match="noise_var must be finite and at least 0"):
        complex_noise((2, 4), np.array([[1.0], [bad]], np.float32), rng)


def test_without_variance_there_is_no_noise(rng):
    assert not complex_noise((4,), 0.0, rng).any()
