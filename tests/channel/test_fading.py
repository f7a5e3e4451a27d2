import math

import numpy as np
import pytest
import scipy  # its parts are loaded where they are used: statistics take seconds

from semcast.channel.fading import clarke_gains, rayleigh_gains, rician_gains


def test_rayleigh_power_is_exponential_with_mean_one(rng):
    gains = rayleigh_gains(20_000, rng)
    power = np.abs(gains.astype(complex)) ** 2
    assert abs(power.mean() - 1) < 4 / math.sqrt(gains.size)
    assert scipy.stats.kstest(power, "expon").pvalue > 1e-4
    assert scipy.stats.kstest(np.angle(gains) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("k_factor_db", [-3.0, 6.0, 15.0])
def test_rician_amplitude_meets_its_distribution(k_factor_db, rng):
    gains = rician_gains(rayleigh_gains(20_000, rng), k_factor_db, 1.0).astype(complex)
    k = 10 ** (k_factor_db / 10)
    scattered_sigma = math.sqrt(0.5 / (1 + k))
    line_of_sight = math.sqrt(k / (1 + k))
    rice = scipy.stats.rice(line_of_sight / scattered_sigma, scale=scattered_sigma)
    assert scipy.stats.kstest(np.abs(gains), rice.cdf).pvalue > 1e-4
    assert np.mean(np.abs(gains) ** 2) == pytest.approx(1.0, abs=0.04)


def test_rician_gains_by_hand():
    # K = 3: three quarters of the power in sight, at a right angle, and a quarter scattered.
    gains = rician_gains(np.array([0, 2, 2j], np.complex64), 10 * math.log10(3), np.pi / 2)
    np.testing.assert_allclose(gains, 1j * math.sqrt(0.75) + np.array([0, 1, 1j]), atol=1e-6)


def test_clarke_gains_have_mean_power_one_and_bessel_autocorrelation():
    doppler_hz, step_s = 20.0, 0.002
    lags = np.array([0, 5, 9, 19])
    total = np.zeros(lags.size, complex)
    runs = 300
    for seed in range(runs):
        gains = clarke_gains(step_s * np.arange(400), doppler_hz, np.random.default_rng(seed)).astype(complex)
        total += [np.mean(gains[lag:] * np.conj(gains[: gains.size - lag])) for lag in lags]
    expected = scipy.special.j0(2 * np.pi * doppler_hz * step_s * lags)
    np.testing.assert_allclose(total / runs, expected, atol=0.06)


def test_clarke_gains_are_gaussian_over_realisations():
    gains = np.array([clarke_gains(np.array([0.3]), 5.0, np.random.default_rng(s))[0] for s in range(3000)])
    assert scipy.stats.kstest(np.abs(gains.astype(complex)) ** 2, "expon").pvalue > 1e-3


def test_clarke_gains_depend_on_time_and_not_on_how_it_is_sampled():
    one = clarke_gains(np.array([0.1, 0.2, 0.7]), 12.0, np.random.default_rng(3))
    other = clarke_gains(np.array([0.7]), 12.0, np.random.default_rng(3))
    np.testing.assert_allclose(one[2], other[0], rtol=1e-5)


def test_without_doppler_the_gain_stands_still():
    gains = clarke_gains(np.linspace(0, 100, 7), 0.0, np.random.default_rng(3))
    np.testing.assert_allclose(gains, gains[0], rtol=1e-5)
