"""Rounding to the four levels of a 16-QAM real: statistics of a Gaussian value that is sent so.

Plain numpy, for both ends: agents without torch use it too.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.qam import SHAPED_OUTER_SHARE, SHAPED_SPACING

#: Distance of the four levels of a real, which are -1.5 to 1.5 of it. Values are rounded to levels one
#: standard deviation apart, so that outer levels are rarer and a mean power of 1/2 takes them further apart:
#: at 10 dB that leaves a seventh less squared error than equally frequent levels do. Where levels lie 0.9 to
#: 1.1 deviations apart it is about the same.
LEVEL_STEP: Final = 2.0 / math.sqrt(10.0) * SHAPED_SPACING
CLIP: Final = 2.0 * LEVEL_STEP
#: Standard deviation of a value before it is rounded.
LOADING: Final = LEVEL_STEP
#: SNR in dB of the link for which ``share_known`` is given, ascending in equal steps.
SNR_GRID_DB: Final = np.arange(-30.0, 40.5, 0.5)


def _density(x: NDArray[np.float64] | float) -> NDArray[np.float64]:
    return np.exp(-0.5 * np.square(x)) / math.sqrt(2.0 * math.pi)


#: Mean size of Gaussian values that got an inner, an outer level.
MEAN_INNER: Final = LOADING * 2.0 * float(_density(0.0) - _density(1.0)) / (1.0 - SHAPED_OUTER_SHARE)
MEAN_OUTER: Final = LOADING * 2.0 * float(_density(1.0)) / SHAPED_OUTER_SHARE


@cache
def share_known() -> NDArray[np.float64]:
    """Return the variance of a value's mean given what arrives, against its own, on ``SNR_GRID_DB``."""
    outer = SHAPED_OUTER_SHARE
    levels = np.array([-1.5, -0.5, 0.5, 1.5]) * LEVEL_STEP
    priors = np.array([outer, 1.0 - outer, 1.0 - outer, outer]) / 2.0
    means = np.array([-MEAN_OUTER, -MEAN_INNER, MEAN_INNER, MEAN_OUTER])
    nodes = np.linspace(-6.0, 6.0, 601)
    weights = _density(nodes) / _density(nodes).sum()
    known = []
    for snr_db in SNR_GRID_DB:
        sd = math.sqrt(0.5 * 10.0 ** (-snr_db / 10.0))
        arrived = levels[:, None] + sd * nodes  # (4 sent, nodes)
        distance = (arrived[..., None] - levels) / sd
        likelihood = priors * np.exp(-0.5 * (distance**2 - (distance**2).min(axis=-1, keepdims=True)))
        mean = (likelihood @ means) / likelihood.sum(axis=-1)
        known.append(float(priors @ (mean**2 @ weights)) / LOADING**2)
    return np.array(known)


def rounded_snr_db(snr_db: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Return the SNR in dB at which an analog value would arrive as well as a rounded one does.

    Where a value's mean given what arrives has the share ``r`` of its variance, that is ``r / (1 - r)``. It
    ends at 8.75 dB on a perfect link: that is what rounding costs.

    Args:
        snr_db: Of the link, for each complex symbol.
    """
    known = np.interp(snr_db, SNR_GRID_DB, share_known())
    return np.asarray(10.0 * np.log10(known / (1.0 - known)))


@cache
def _cosines(size: int) -> NDArray[np.float32]:
    """Return the orthonormal matrix of the discrete cosine transform."""
    frequency, place = np.arange(size)[:, None], np.arange(size)[None]
    matrix = np.cos(math.pi * (place + 0.5) * frequency / size) * math.sqrt(2.0 / size)
    matrix[0] /= math.sqrt(2.0)
    return matrix.astype(np.float32)


def _hash(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return 32 bits without any order for each number, the same everywhere (finaliser of MurmurHash3)."""
    mask = np.uint64(0xFFFFFFFF)
    mixed = numbers & mask
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        mixed = ((mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)) & mask
    return np.asarray(mixed ^ (mixed >> np.uint64(16)))


@dataclass(frozen=True)
class Mixing:
    """What spreads the values ``(C, w)`` of a slot over its symbols: shuffle, change signs, two transforms.

    Attributes:
        order: ``(C w,)`` int64: which value comes to which place.
        inverse: ``(C w,)`` int64: the place of each value.
        signs: ``(C, w)`` of +-1.
        columns: ``(w, w)`` orthonormal.
        channels: ``(C, C)`` orthonormal.
    """

    order: NDArray[np.int64]
    inverse: NDArray[np.int64]
    signs: NDArray[np.float32]
    columns: NDArray[np.float32]
    channels: NDArray[np.float32]


@cache
def mixing(channels: int, columns: int) -> Mixing:
    """Return the fixed mixing of slots of ``columns`` blocks, see ``modulation.spread``."""
    places = np.arange(1, channels * columns + 1, dtype=np.uint64)
    first = _hash(places)
    signs = np.where(_hash(first + places) & np.uint64(1), -1.0, 1.0).astype(np.float32)
    order = np.argsort(first, kind="stable")
    return Mixing(
        order,
        np.argsort(order),
        signs.reshape(channels, columns),
        _cosines(columns),
        _cosines(channels),
    )
