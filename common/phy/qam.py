"""Gray-mapped square QAM: bits, symbol indices and complex symbols, and soft demapping.

A symbol of ``b`` bits is two independent Gray-mapped PAM reals of ``b / 2`` bits, the first half of the bits
in the real part. The default, 16-QAM, has the levels -3, -1, 1, 3 over sqrt(10) with the bits 00, 01, 11, 10,
so that neighbouring levels differ in one bit and the mean symbol power is 1.

A learned transmitter sends the outer levels less often than the inner ones, as its values are about Gaussian.
Its points therefore lie ``SHAPED_SPACING`` times further apart at the same mean power (probabilistic shaping,
Böcherer et al. 2015).
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

BITS_PER_SYMBOL_16QAM = 4
#: Supported bits per symbol: QPSK, 16-QAM, 64-QAM.
BITS_PER_SYMBOL = (2, 4, 6)
#: Share of the outer levels where a Gaussian is rounded to levels one standard deviation apart.
SHAPED_OUTER_SHARE: Final = math.erfc(math.sqrt(0.5))
#: Distance of shaped levels against that of equally frequent ones of the same power: 1.19.
SHAPED_SPACING: Final = math.sqrt(5.0 / (1.0 + 8.0 * SHAPED_OUTER_SHARE))


def _check_bits(bits_per_symbol: int) -> int:
    if bits_per_symbol not in BITS_PER_SYMBOL:
        raise ValueError(f"bits_per_symbol must be in {BITS_PER_SYMBOL}, got {bits_per_symbol}")
    return 1 << (bits_per_symbol // 2)


def pam_levels(bits_per_symbol: int = BITS_PER_SYMBOL_16QAM) -> NDArray[np.float32]:
    """Return the ascending PAM levels of one real dimension, scaled to unit mean symbol power."""
    num_levels = _check_bits(bits_per_symbol)
    steps = 2.0 * np.arange(num_levels) - (num_levels - 1)
    return np.asarray(steps / np.sqrt(2.0 * (num_levels**2 - 1) / 3.0), dtype=np.float32)


def _gray(level: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(level ^ (level >> 1), dtype=np.uint8)


def constellation(bits_per_symbol: int = BITS_PER_SYMBOL_16QAM) -> NDArray[np.complex64]:
    """Return the points in index order: the index read as bits, most significant first, is the label."""
    levels = pam_levels(bits_per_symbol)
    by_label = np.empty_like(levels)
    by_label[_gray(np.arange(levels.size, dtype=np.uint8))] = levels
    return np.asarray(by_label[:, None] + 1j * by_label[None, :], dtype=np.complex64).reshape(-1)


def indices_to_symbols(
    indices: NDArray[np.uint8], bits_per_symbol: int = BITS_PER_SYMBOL_16QAM
) -> NDArray[np.complex64]:
    """Map indices of any shape to complex symbols of the same shape.

    Raises:
        ValueError: An index is outside the constellation.
    """
    points = constellation(bits_per_symbol)
    if indices.size and (int(indices.max()) >= points.size or int(indices.min()) < 0):
        raise ValueError(
            f"indices must be in [0, {points.size - 1}], got {int(indices.min())} to {int(indices.max())}"
        )
    return points[indices]


def _nearest_level(values: NDArray[np.float32], bits_per_symbol: int) -> NDArray[np.uint8]:
    levels = pam_levels(bits_per_symbol)
    scaled = (values - levels[0]) * np.float32(1.0 / (levels[1] - levels[0]))
    return np.asarray(np.clip(np.rint(scaled), 0, levels.size - 1), dtype=np.uint8)


def symbols_to_indices(
    symbols: NDArray[np.complex64], bits_per_symbol: int = BITS_PER_SYMBOL_16QAM
) -> NDArray[np.uint8]:
    """Decide for the nearest point of each finite symbol; the inverse of ``indices_to_symbols``."""
    _check_bits(bits_per_symbol)
    label_i = _gray(_nearest_level(symbols.real, bits_per_symbol))
    label_q = _gray(_nearest_level(symbols.imag, bits_per_symbol))
    return (label_i << np.uint8(bits_per_symbol // 2)) | label_q


def bits_to_indices(
    bits: NDArray[np.uint8], bits_per_symbol: int = BITS_PER_SYMBOL_16QAM
) -> NDArray[np.uint8]:
    """Group bits ``(..., n * bits_per_symbol)`` of 0 and 1 into indices ``(..., n)``, first bit highest.

    Raises:
        ValueError: The bits don't fill whole symbols.
    """
    _check_bits(bits_per_symbol)
    if bits.shape[-1] % bits_per_symbol:
        raise ValueError(f"number of bits must be a multiple of {bits_per_symbol}, got {bits.shape[-1]}")
    groups = bits.reshape(*bits.shape[:-1], -1, bits_per_symbol)
    weights = (1 << np.arange(bits_per_symbol - 1, -1, -1)).astype(np.uint8)
    return np.asarray((groups * weights).sum(axis=-1, dtype=np.uint8))


def pack_indices(indices: NDArray[np.uint8]) -> bytes:
    """Pack 16-QAM indices, flattened, two to a byte, the first in the high half, padded with 0.

    Raises:
        ValueError: An index is above 15.
    """
    flat = np.ascontiguousarray(indices, dtype=np.uint8).reshape(-1)
    if flat.size and int(flat.max()) > 15:
        raise ValueError(f"indices must be in [0, 15], got {int(flat.max())}")
    if flat.size % 2:
        flat = np.append(flat, np.uint8(0))
    return ((flat[0::2] << np.uint8(4)) | flat[1::2]).tobytes()


def unpack_indices(payload: bytes, count: int) -> NDArray[np.uint8]:
    """Return the ``(count,)`` indices that ``pack_indices`` packed.

    Raises:
        ValueError: The payload doesn't have exactly ``ceil(count / 2)`` bytes.
    """
    expected = (count + 1) // 2
    if count < 0 or len(payload) != expected:
        raise ValueError(f"payload for {count} indices must have {expected} bytes, got {len(payload)}")
    packed = np.frombuffer(payload, dtype=np.uint8)
    indices = np.empty(2 * expected, dtype=np.uint8)
    indices[0::2] = packed >> 4
    indices[1::2] = packed & 15
    return indices[:count]


def soft_demap(
    symbols: NDArray[np.complex64],
    noise_var: NDArray[np.float32] | float,
    bits_per_symbol: int = BITS_PER_SYMBOL_16QAM,
) -> NDArray[np.float32]:
    """Return log-likelihood ratios ``ln P(bit = 0) / P(bit = 1)`` of equally likely bits.

    Args:
        symbols: ``(..., n)`` complex, unbiased: ``s + noise``. Undo the MMSE shrinkage first.
        noise_var: Complex noise variance, broadcast against ``symbols``; ``inf`` gives LLR 0.
        bits_per_symbol: 2, 4 or 6.

    Returns:
        ``(..., n * bits_per_symbol)`` float32 in the bit order of ``bits_to_indices``.

    Raises:
        ValueError: A noise variance is not positive.
    """
    _check_bits(bits_per_symbol)
    variance = np.asarray(noise_var, dtype=np.float32)
    if not bool(np.all(variance > 0)):
        raise ValueError(f"noise_var must be positive, got {float(np.min(variance))}")
    precision = np.broadcast_to(np.float32(1.0) / variance, symbols.shape)
    halves = [
        _pam_llr(np.ascontiguousarray(part, dtype=np.float32), precision, bits_per_symbol)
        for part in (symbols.real, symbols.imag)
    ]
    return np.concatenate(halves, axis=-1).reshape(*symbols.shape[:-1], -1)


def _pam_llr(
    values: NDArray[np.float32], precision: NDArray[np.float32], bits_per_symbol: int
) -> NDArray[np.float32]:
    """Return ``(..., bits_per_symbol / 2)`` LLRs of one real dimension."""
    levels = pam_levels(bits_per_symbol)
    num_bits = bits_per_symbol // 2
    labels = _gray(np.arange(levels.size, dtype=np.uint8))
    # Distances are taken relative to the nearest level, so that exp() never underflows on every level.
    metric = np.stack([-precision * np.square(values - level) for level in levels])
    metric -= metric.max(axis=0)
    likelihood = np.exp(metric, out=metric)
    tiny = np.float32(1e-37)
    llr = np.empty((*values.shape, num_bits), dtype=np.float32)
    for bit in range(num_bits):
        is_one = ((labels >> (num_bits - 1 - bit)) & 1).astype(bool)
        zero = np.log(np.maximum(likelihood[~is_one].sum(axis=0), tiny))
        one = np.log(np.maximum(likelihood[is_one].sum(axis=0), tiny))
        llr[..., bit] = zero - one
    return llr
