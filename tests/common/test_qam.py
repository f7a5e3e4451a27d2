import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcast.common.phy import qam


def bits_of(indices, bits_per_symbol=4):
    """Spread indices ``(..., n)`` into bits ``(..., n * bits_per_symbol)``, highest bit first."""
    bits = indices[..., None] >> np.arange(bits_per_symbol - 1, -1, -1, dtype=np.uint8) & 1
    return bits.reshape(*indices.shape[:-1], -1)


def test_levels_of_16qam_are_odd_multiples_over_sqrt_10():
    np.testing.assert_allclose(qam.pam_levels(4), np.array([-3, -1, 1, 3]) / math.sqrt(10), rtol=1e-6)


def test_shaped_points_have_unit_power_at_the_frequencies_of_a_rounded_gaussian(rng):
    values = rng.standard_normal(400_000)
    levels = (np.floor(values).clip(-2, 1) + 0.5) * 2 / math.sqrt(10) * qam.SHAPED_SPACING
    assert 2 * np.mean(levels**2) == pytest.approx(1.0, abs=0.01)
    assert np.mean(np.abs(values) > 1) == pytest.approx(qam.SHAPED_OUTER_SHARE, abs=0.003)
    assert math.isclose(qam.SHAPED_SPACING, (5 / (1 + 8 * 0.317311)) ** 0.5, rel_tol=1e-5)


@pytest.mark.parametrize("bits", qam.BITS_PER_SYMBOL)
def test_constellation_has_unit_mean_power_and_distinct_points(bits):
    points = qam.constellation(bits)
    assert points.shape == (1 << bits,)
    assert np.mean(np.abs(points) ** 2) == pytest.approx(1.0, abs=1e-6)
    assert np.unique(points).size == 1 << bits


@pytest.mark.parametrize("bits", qam.BITS_PER_SYMBOL)
def test_nearest_neighbours_differ_in_one_bit(bits):
    points = qam.constellation(bits)
    distance = np.abs(points[:, None] - points[None, :])
    np.fill_diagonal(distance, np.inf)
    a, b = np.nonzero(np.isclose(distance, distance.min(), rtol=1e-4))
    assert a.size > 0
    assert all(bin(i ^ j).count("1") == 1 for i, j in zip(a.tolist(), b.tolist(), strict=True))


def test_hand_computed_point():
    # 0b1001: real bits 10 -> +3, imaginary bits 01 -> -1.
    point = qam.indices_to_symbols(np.array([0b1001], np.uint8))[0]
    assert point == pytest.approx((3 - 1j) / math.sqrt(10), abs=1e-6)


def test_a_payload_is_read_as_the_page_on_file_formats_says():
    level = {0b00: -3, 0b01: -1, 0b11: 1, 0b10: 3}
    payload = bytes([0x0D, 0x72])
    halves = [half for byte in payload for half in (byte >> 4, byte & 15)]
    expected = [(level[k >> 2] + 1j * level[k & 3]) / np.sqrt(10) for k in halves]
    got = qam.indices_to_symbols(qam.unpack_indices(payload, 4))
    np.testing.assert_allclose(got, expected, rtol=1e-6)


@given(st.lists(st.integers(0, 15), min_size=0, max_size=65))
def test_packing_round_trips(values):
    indices = np.array(values, dtype=np.uint8)
    payload = qam.pack_indices(indices)
    assert len(payload) == (len(values) + 1) // 2
    np.testing.assert_array_equal(qam.unpack_indices(payload, len(values)), indices)


@given(st.sampled_from(qam.BITS_PER_SYMBOL), st.integers(0, 2**32 - 1))
def test_bits_indices_and_symbols_round_trip(bits, seed):
    data = np.random.default_rng(seed).integers(0, 2, (3, 5 * bits)).astype(np.uint8)
    indices = qam.bits_to_indices(data, bits)
    assert indices.shape == (3, 5)
    np.testing.assert_array_equal(bits_of(indices, bits), data)
    symbols = qam.indices_to_symbols(indices, bits)
    np.testing.assert_array_equal(qam.symbols_to_indices(symbols, bits), indices)


def test_far_away_symbols_are_decided_for_the_corner():
    np.testing.assert_array_equal(
        qam.symbols_to_indices(np.array([100 + 100j, -100 - 100j], np.complex64)), [0b1010, 0b0000]
    )


def test_sign_of_the_llr_is_the_bit(rng):
    bits = rng.integers(0, 2, 4000).astype(np.uint8)
    symbols = qam.indices_to_symbols(qam.bits_to_indices(bits))
    llr = qam.soft_demap(symbols, 0.05)
    np.testing.assert_array_equal(llr < 0, bits == 1)


def test_llr_matches_the_sum_over_all_points_written_out():
    y, noise_var = np.complex64(0.31 - 0.72j), 0.4
    points = qam.constellation()
    likelihood = np.exp(-(np.abs(y - points) ** 2) / noise_var)
    labels = bits_of(np.arange(16, dtype=np.uint8)[:, None])
    expected = [
        math.log(likelihood[labels[:, k] == 0].sum() / likelihood[labels[:, k] == 1].sum()) for k in range(4)
    ]
    np.testing.assert_allclose(qam.soft_demap(np.array([y]), noise_var), expected, rtol=1e-4)


def test_llr_is_calibrated(rng):
    # Among bits whose LLR is near L, the share of ones must be 1 / (1 + exp(L)).
    bits = rng.integers(0, 2, 400_000).astype(np.uint8)
    noise_var = 10 ** (-0.6)
    symbols = qam.indices_to_symbols(qam.bits_to_indices(bits))
    noise = rng.standard_normal((symbols.size, 2)) @ np.array([1, 1j]) * math.sqrt(noise_var / 2)
    llr = qam.soft_demap((symbols + noise).astype(np.complex64), noise_var)
    for low in (-2.0, -1.0, 0.0, 1.0):
        chosen = (llr > low) & (llr < low + 0.5)
        expected = np.mean(1 / (1 + np.exp(llr[chosen])))
        sigma = math.sqrt(expected * (1 - expected) / chosen.sum())
        assert abs(bits[chosen].mean() - expected) < 4 * sigma


def test_infinite_noise_gives_zero_llr_and_high_snr_stays_finite():
    symbols = qam.constellation()
    assert not qam.soft_demap(symbols, np.inf).any()
    assert np.isfinite(qam.soft_demap(symbols, 1e-6)).all()


def test_llr_far_from_all_points_is_the_difference_of_squared_distances_up_to_a_bound():
    # QPSK levels -a and a, a = 1 / sqrt(2): both likelihoods of 6, exp(-93) and exp(-150), are below 1e-37.
    llr = qam.soft_demap(np.array([6 - 6j], np.complex64), 0.3, 2)
    np.testing.assert_allclose(llr, 4 * 6 * math.sqrt(0.5) / 0.3 * np.array([-1, 1]), rtol=1e-5)
    bounded = qam.soft_demap(np.array([6 - 6j], np.complex64), 0.01, 2)
    np.testing.assert_allclose(bounded, math.log(1e37) * np.array([-1, 1]), rtol=1e-5)


@pytest.mark.parametrize("snr_db", [4.0, 8.0, 12.0])
def test_uncoded_bit_error_rate_meets_the_closed_form(snr_db, rng):
    # Gray 16-QAM: P = (3 Q(a) + 2 Q(3a) - Q(5a)) / 4 with a = sqrt(snr / 5).
    def q(x):
        return 0.5 * math.erfc(x / math.sqrt(2))

    a = math.sqrt(10 ** (snr_db / 10) / 5)
    expected = (3 * q(a) + 2 * q(3 * a) - q(5 * a)) / 4
    indices = rng.integers(0, 16, 200_000).astype(np.uint8)
    noise = rng.standard_normal((indices.size, 2)) @ np.array([1, 1j]) * math.sqrt(0.5 * 10 ** (-snr_db / 10))
    decided = qam.symbols_to_indices((qam.indices_to_symbols(indices) + noise).astype(np.complex64))
    wrong = bits_of(decided ^ indices)
    sigma = math.sqrt(expected * (1 - expected) / wrong.size)
    assert abs(wrong.mean() - expected) < 4 * sigma


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"bits_per_symbol must be in \(2, 4, 6\), got 3"):
        qam.pam_levels(3)
    with pytest.raises(ValueError, match=r"indices must be in \[0, 15\], got 3 to 16"):
        qam.indices_to_symbols(np.array([3, 16], np.uint8))
    with pytest.raises(ValueError, match=r"indices must be in \[0, 15\], got 16"):
        qam.pack_indices(np.array([16], np.uint8))
    with pytest.raises(ValueError, match="payload for 3 indices must have 2 bytes, got 1"):
        qam.unpack_indices(b"\x00", 3)
    with pytest.raises(ValueError, match="multiple of 4, got 5"):
        qam.bits_to_indices(np.zeros(5, np.uint8))
    with pytest.raises(ValueError, match="noise_var must be positive, got 0.0"):
        qam.soft_demap(qam.constellation(), 0.0)
