"""The transmitter's modulation without torch, for agents that run an exported encoder.

The same rules as ``modulation``, value for value; a test holds both together.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import Modulation
from semcast.common.nets.rounding import LEVEL_STEP, LOADING, mixing
from semcast.common.phy.slots import LATENT_CHANNELS

#: Amplitude of the carrier against a latent whose rms is about 0.9: some 2 % of the power.
CARRIER_AMPLITUDE = 0.12


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


def carrier_pattern(channels: int, rows: int, columns: int) -> NDArray[np.float32]:
    """Return the known ``(C, h, w)`` pattern of +-1."""
    channel = np.arange(channels)
    sign = 1.0 - 2.0 * ((channel * (channel + 1) // 2) % 2)
    board = 1.0 - 2.0 * ((np.arange(rows)[:, None] + np.arange(columns)) % 2)
    return (sign[:, None, None] * board).astype(np.float32)


def analog_symbols(latent: NDArray[np.float32], sent: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """Add the carrier and scale the frame to average power 1/2 for each real value that is sent."""
    pattern = carrier_pattern(*latent.shape)
    share = np.float64(1.0)
    if sent is not None:
        latent, pattern, share = latent * sent, pattern * sent, sent.mean()
    y = latent - np.float32((latent * pattern).mean(dtype=np.float64) / share) * pattern
    y = y + np.float32(CARRIER_AMPLITUDE) * pattern
    power = np.square(y).mean(dtype=np.float64) / share
    return np.asarray(y / np.sqrt(2.0 * power + 1e-12), dtype=np.float32)


def pack(symbols: NDArray[np.float32], sent: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Put the values ``(C, h, w)`` of blocks into slots, ``(94, h, w)``; see ``packing.pack``."""
    _, rows, columns = symbols.shape
    stream = np.empty(rows * columns * LATENT_CHANNELS, dtype=np.float32)
    chosen = symbols.transpose(1, 2, 0)[sent.transpose(1, 2, 0)]
    stream[: chosen.size] = chosen
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
        symbols = analog_symbols(latent)
    else:
        sent = np.arange(len(latent))[:, None, None] < values
        symbols = pack(analog_symbols(latent, sent), sent)
    if modulation == "analog":
        return symbols
    return nearest_level(np.float32(2.0**0.5 * LOADING) * spread(symbols))
