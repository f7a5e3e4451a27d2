"""Transmit power: unit average over one image, the reference of every SNR in this project."""

import numpy as np
from numpy.typing import NDArray


def mean_power(symbols: NDArray[np.complex64]) -> float:
    """Return the mean of ``|s|^2`` over all symbols.

    Raises:
        ValueError: There are no symbols, or one is not finite.
    """
    if symbols.size == 0:
        raise ValueError("symbols must not be empty")
    flat = np.ascontiguousarray(symbols).reshape(-1)
    power = float(np.vdot(flat, flat).real) / flat.size
    if not np.isfinite(power):
        raise ValueError("symbols must be finite")
    return power


def normalise_power(symbols: NDArray[np.complex64]) -> tuple[NDArray[np.complex64], float]:
    """Scale the symbols of one image, never of a batch, to unit average power; and return what they had.

    The scale is not told to the receiver: the pilots go through it as well and carry it.

    Raises:
        ValueError: The symbols are empty, not finite or all zero.
    """
    power = mean_power(symbols)
    if power <= 0.0:
        raise ValueError("symbols must have power above 0, got 0")
    return (symbols * np.float32(1.0 / np.sqrt(power))).astype(np.complex64, copy=False), power
