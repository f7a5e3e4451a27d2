import numpy as np
import pytest

from semcast.common.nets.latent import latent_from_symbols, symbols_from_latent


def test_latent_and_symbols_are_inverse_of_each_other():
    latent = np.random.default_rng(0).normal(size=(94, 3, 5)).astype(np.float32)
    symbols = symbols_from_latent(latent)
    assert symbols.shape == (3, 47 * 5)
    assert symbols.dtype == np.complex64
    np.testing.assert_array_equal(latent_from_symbols(symbols), latent)


def test_channels_2k_and_2k_plus_1_are_real_and_imaginary_part_of_symbol_47c_plus_k():
    latent = np.zeros((94, 2, 3), np.float32)
    latent[10, 1, 2], latent[11, 1, 2] = 3.0, -4.0
    symbols = symbols_from_latent(latent)
    assert symbols[1, 47 * 2 + 5] == 3.0 - 4.0j
    assert np.count_nonzero(symbols) == 1


def test_symbol_energy_is_latent_energy():
    latent = np.random.default_rng(1).normal(size=(94, 2, 2)).astype(np.float32)
    assert np.sum(np.abs(symbols_from_latent(latent)) ** 2) == pytest.approx(np.sum(latent**2), rel=1e-5)


def test_a_latent_of_the_wrong_depth_is_refused():
    with pytest.raises(ValueError, match="94"):
        symbols_from_latent(np.zeros((96, 1, 1), np.float32))


def test_symbols_that_are_no_whole_blocks_are_refused():
    with pytest.raises(ValueError, match="multiple of 47, got 48"):
        latent_from_symbols(np.zeros((1, 48), np.complex64))
