"""The one place that says which real latent value becomes which part of which channel symbol.

Latent ``(94, h, w)``: channels ``2k`` and ``2k + 1`` of block ``(r, c)`` are the real and imaginary part of
data symbol ``47 c + k`` of slot ``r``. A block's symbols are therefore neighbours on the air.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.slots import DATA_PER_BLOCK, LATENT_CHANNELS
from semcast.common.shapes import check_shape


def symbols_from_latent(latent: NDArray[np.float32]) -> NDArray[np.complex64]:
    """Pair the real latent values of one frame into data symbols.

    Args:
        latent: ``(94, h, w)`` real values, already scaled for the channel.

    Returns:
        ``(h, 47 * w)`` complex64: one row for each slot.

    Raises:
        ValueError: The latent does not have 94 channels.
    """
    sizes = check_shape(latent, f"{LATENT_CHANNELS} h w", "latent")
    pairs = np.ascontiguousarray(latent.transpose(1, 2, 0), dtype=np.float32)  # (h, w, 94)
    return pairs.view(np.complex64).reshape(sizes["h"], sizes["w"] * DATA_PER_BLOCK)


def latent_from_symbols(symbols: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Invert ``symbols_from_latent``.

    Args:
        symbols: ``(h, 47 * w)`` complex symbols.

    Returns:
        ``(94, h, w)`` float32.

    Raises:
        ValueError: The symbols are not a whole number of blocks in each slot.
    """
    sizes = check_shape(symbols, "h n", "symbols")
    if sizes["n"] % DATA_PER_BLOCK:
        raise ValueError(f"symbols per slot must be a multiple of {DATA_PER_BLOCK}, got {sizes['n']}")
    whole = np.ascontiguousarray(symbols, dtype=np.complex64)
    parts = whole.view(np.float32).reshape(sizes["h"], sizes["n"] // DATA_PER_BLOCK, LATENT_CHANNELS)
    return np.ascontiguousarray(parts.transpose(2, 0, 1))
