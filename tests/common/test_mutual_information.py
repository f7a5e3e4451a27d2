"""Mutual information of constellations, against its limits and a simulation."""

import numpy as np
import pytest

from semcast.common.phy.mutual_information import mutual_information, snr_db_that_carries
from semcast.common.phy.qam import constellation


@pytest.mark.parametrize("bits", [2, 4, 6])
def test_it_is_nothing_in_noise_and_all_bits_without(bits):
    assert mutual_information(bits, np.array([0.0])) == 0.0
    assert mutual_information(bits, np.array([1e6])) == pytest.approx(bits, abs=1e-3)


@pytest.mark.parametrize("bits", [2, 4, 6])
def test_at_low_snr_it_is_what_any_signal_carries(bits):
    snr = np.array([0.05])
    assert mutual_information(bits, snr) == pytest.approx(np.log2(1 + snr), rel=0.01)


@pytest.mark.parametrize(("bits", "snr_db"), [(2, 3.0), (4, 10.0), (6, 14.0)])
def test_it_is_what_a_simulation_finds(bits, snr_db):
    rng = np.random.default_rng(bits)
    points = constellation(bits).astype(np.complex128)
    sent = rng.integers(0, len(points), 40_000)
    noise_var = 10 ** (-snr_db / 10)
    noise = np.sqrt(noise_var / 2) * (rng.normal(size=sent.size) + 1j * rng.normal(size=sent.size))
    likelihood = np.exp(-(np.abs((points[sent] + noise)[:, None] - points) ** 2) / noise_var)
    found = np.mean(np.log2(likelihood[np.arange(sent.size), sent] / likelihood.mean(axis=1)))
    assert mutual_information(bits, np.array([10 ** (snr_db / 10)])) == pytest.approx(found, abs=0.02)


def test_it_can_be_inverted():
    for snr_db in (-5.0, 4.0, 13.0):
        bits = float(mutual_information(4, np.array(10 ** (snr_db / 10))))
        assert snr_db_that_carries(4, bits) == pytest.approx(snr_db, abs=0.01)


def test_it_can_be_inverted_where_the_constellation_is_full_and_beyond_what_it_carries():
    full = float(mutual_information(2, np.array(100.0)))
    assert full == pytest.approx(2.0, abs=1e-6)
    assert snr_db_that_carries(2, full) == pytest.approx(20.0, abs=0.01)
    assert snr_db_that_carries(2, 2.1) == pytest.approx(30.0)
    assert snr_db_that_carries(2, -0.1) == -20.0


def test_constellations_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match="bits_per_symbol must be in"):
        mutual_information(3, np.array([1.0]))
