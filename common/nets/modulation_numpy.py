"""The transmitter's modulation without torch, for agents that run an exported encoder.

The same rules as ``modulation``, value for value; a test holds both together.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import Modulation
from semcast.common.nets.rounding import LEVEL_STEP, LOADING, mixing
from semcast.common.phy.slots import LATENT_CHANNELS

#: Amplitude of the carrier against a latent whose rms is about 0.9: some 2 % of the power.
CARRIER_AMPLITUDE = 0.12
#: Sizes whose carrier is kept: a stream has one, with an adaptive rate a few.
_REMEMBERED = 8


def nearest_level(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round every value to the nearest level of shaped 16-QAM."""
    step = np.float32(LEVEL_STEP)
    return np.asarray((np.floor(values / step).clip(-2.0, 1.0) + np.float32(0.5)) * step, dtype=np.float32)


def spread(symbols: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mix the values ``(C, h, w)`` of every slot, so that each symbol has a part of all."""
    num_channels, rows, num_columns = symbols.shape
    of = mixing(num_channels, num_columns)
    slots = symbols.transpose(1, 0, 2)  # (h, C, w)
    shuffled = slots.reshape(rows, -1)[:, of.order].reshape(slots.shape) * of.signs
    return np.asarray((of.channels @ (shuffled @ of.columns.T)).transpose(1, 0, 2), dtype=np.float32)


@lru_cache(maxsize=_REMEMBERED)
def carrier_pattern(channels: int, rows: int, columns: int) -> NDArray[np.float32]:
    """Return the known ``(C, h, w)`` pattern of +-1, which can't be written to."""
    channel = np.arange(channels)
    sign = 1.0 - 2.0 * ((channel * (channel + 1) // 2) % 2)
    board = 1.0 - 2.0 * ((np.arange(rows)[:, None] + np.arange(columns)) % 2)
    pattern = (sign[:, None, None] * board).astype(np.float32)
    pattern.flags.writeable = False  # it will be handed out again
    return pattern


def _with_carrier(
    latent: NDArray[np.float32], sent: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], np.float64]:
    """Put the carrier into a frame: what is to be sent, and what to divide it by for power 1/2 of each real.

    Frames are megabytes: fetching fresh memory for every step took longer than the arithmetic.
    """
    pattern, share = carrier_pattern(*latent.shape), np.float64(1.0)
    y = latent.copy() if sent is None else latent * sent
    if sent is not None:
        pattern, share = pattern * sent, np.float64(np.count_nonzero(sent) / sent.size)
    scratch = np.multiply(y, pattern)
    level = np.float32(scratch.mean(dtype=np.float64) / share)
    y -= np.multiply(pattern, level, out=scratch)
    y += np.multiply(pattern, np.float32(CARRIER_AMPLITUDE), out=scratch)
    power = np.square(y, out=scratch).mean(dtype=np.float64) / share
    return y, np.sqrt(2.0 * power + 1e-12)


def _divided(values: NDArray[np.float32], divisor: np.float64) -> NDArray[np.float32]:
    return np.asarray(values / divisor, dtype=np.float32)


def _pack(symbols: NDArray[np.float32], sent: NDArray[np.bool_], divisor: np.float64) -> NDArray[np.float32]:
    """Put the values ``(C, h, w)`` of blocks, divided, into slots, ``(94, h, w)``; see ``packing.pack``."""
    _, rows, columns = symbols.shape
    stream = np.empty(rows * columns * LATENT_CHANNELS, dtype=np.float32)
    chosen = symbols.transpose(1, 2, 0)[sent.transpose(1, 2, 0)]
    stream[: chosen.size] = _divided(chosen, divisor)
    place = np.arange(stream.size - chosen.size)
    stream[chosen.size :] = 0.5**0.5 * (1.0 - 2.0 * (place * (place + 1) // 2 % 2))
    return stream.reshape(rows, columns, LATENT_CHANNELS).transpose(2, 0, 1)


def transmit(
    latent: NDArray[np.float32], modulation: Modulation, values: NDArray[np.int64] | None = None
) -> NDArray[np.float32]:
    """Modulate the latent of one frame: real parts of power 1/2 of unit-power symbols, ``(94, h, w)``.

    Args:
        latent: ``(94, h, w)``, or ``(C, h, w)`` with ``values``.
        modulation: How symbols travel.
        values: ``(h, w)`` how many values each block sends, where the rate is variable.
    """
    if values is None:
        symbols = _divided(*_with_carrier(latent, None))
    else:
        sent = np.arange(len(latent))[:, None, None] < values
        symbols, divisor = _with_carrier(latent, sent)
        symbols = _pack(symbols, sent, divisor)
    if modulation == "analog":
        return symbols
    return nearest_level(np.float32(2.0**0.5 * LOADING) * spread(symbols))
