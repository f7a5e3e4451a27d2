"""Slots and frames that don't arrive, and bursts that hit several slots in a row."""

import numpy as np
from numpy.typing import NDArray


def independent_losses(num: int, probability: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return ``(num,)`` flags, each true with ``probability`` on its own."""
    return rng.random(num) < probability


def least_burst(bad_share: float) -> float:
    """Return the mean length that bursts must have at least, for so many slots to be bad.

    Not above the very limit, where a single good slot parts them, by what 1 - ``bad_share`` is rounded off.
    """
    return (1.0 - 1e-9) * bad_share / (1.0 - bad_share)


def gilbert_elliott(
    num: int, bad_share: float, mean_burst: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return ``(num,)`` flags of a two-state Markov chain, true in the bad state.

    The chain starts in its stationary distribution, so every slot is bad with ``bad_share``.

    Args:
        num: Length.
        bad_share: Share of bad slots in the long run, in [0, 1).
        mean_burst: Mean length of a run of bad slots, at least 1.
        rng: Source of randomness.

    Raises:
        ValueError: A value is out of range, or so many bad slots can't come in bursts so short.
    """
    if not 0.0 <= bad_share < 1.0:
        raise ValueError(f"bad_share must be in [0, 1), got {bad_share}")
    if mean_burst < 1.0:
        raise ValueError(f"mean_burst must be at least 1, got {mean_burst}")
    leave_bad = 1.0 / mean_burst
    leave_good = leave_bad * bad_share / (1.0 - bad_share)
    least = least_burst(bad_share)
    if mean_burst < least:
        raise ValueError(
            f"mean_burst must be at least {least:g} for a share of {bad_share}, got {mean_burst}"
        )
    draws = rng.random(num)
    bad = draws < bad_share  # holds for the first one; each of the others depends on the one before it
    for k in range(1, num):
        bad[k] = draws[k] >= leave_bad if bad[k - 1] else draws[k] < leave_good
    return bad
