"""Bits that a symbol of square QAM carries over additive white Gaussian noise, all points sent alike."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.qam import pam_levels

#: SNRs at which it is tabulated, and points of the quadrature over the noise.
_GRID_DB = np.arange(-20.0, 30.01, 0.25)
_NUM_NODES = 64


def mutual_information(bits_per_symbol: int, snr: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mutual information in bits of a symbol, at linear SNRs of any shape.

    Raises:
        ValueError: There is no constellation of so many bits.
    """
    snr_db = 10.0 * np.log10(np.maximum(snr, 1e-12))
    return np.asarray(
        np.where(snr_db < _GRID_DB[0], 0.0, np.interp(snr_db, _GRID_DB, _table(bits_per_symbol)))
    )


def snr_db_that_carries(bits_per_symbol: int, bits: float) -> float:
    """Return the SNR in dB, within -20 to 30, at which a symbol carries ``bits``."""
    return float(np.interp(bits, _table(bits_per_symbol), _GRID_DB))


@cache
def _table(bits_per_symbol: int) -> NDArray[np.float64]:
    """Return the mutual information on ``_GRID_DB``: twice that of one of its two reals."""
    levels = pam_levels(bits_per_symbol).astype(np.float64)
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NUM_NODES)
    weights = weights / weights.sum()
    table = []
    for snr_db in _GRID_DB:
        sd = np.sqrt(0.5 * 10.0 ** (-snr_db / 10.0))
        # Log likelihoods of all levels against that of the level sent, at the nodes of the noise.
        offset = (levels[:, None] - levels) / sd
        ratio = -0.5 * np.square(offset)[:, None] - offset[:, None] * nodes[:, None]  # (sent, node, level)
        doubt = np.log2(np.exp(ratio).sum(axis=2))
        table.append(2.0 * (np.log2(len(levels)) - float(np.mean(doubt @ weights))))
    # Rising to the end, so that it can be inverted where the constellation is full.
    return np.asarray(np.array(table) + 1e-9 * np.arange(len(table)), dtype=np.float64)
