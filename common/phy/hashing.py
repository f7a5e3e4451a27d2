"""Pseudo-random words and symbols that both ends compute alike, whatever their libraries' generators are.

SplitMix64 (Steele et al. 2014): a counter in steps of ``INCREMENT`` through a mixing function.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Of SplitMix64's counter: 2**64 over the golden ratio, made odd.
INCREMENT: Final = np.uint64(0x9E3779B97F4A7C15)


def mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Hash 64-bit integers of any shape, as SplitMix64 does with its counter."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(x ^ (x >> np.uint64(31)), dtype=np.uint64)


def hash_words(count: int, key: int) -> NDArray[np.uint64]:
    """Return ``(count,)`` pseudo-random words; those of different keys, below 2**24, don't overlap."""
    return mix((np.arange(1, count + 1, dtype=np.uint64) + np.uint64(key << 40)) * INCREMENT)


def hashed_qpsk(words: NDArray[np.uint64]) -> NDArray[np.complex64]:
    """Return a point (+-1 +-1j) / sqrt(2) for each word, chosen by its two highest bits."""
    quadrant = (words >> np.uint64(62)).astype(np.int8)
    points = ((1 - 2 * (quadrant & 1)) + 1j * (1 - 2 * (quadrant >> 1))) / np.sqrt(2.0)
    return np.asarray(points, dtype=np.complex64)
