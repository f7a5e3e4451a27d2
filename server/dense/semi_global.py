"""Smoothing of a cost volume along lines of pixels: semi-global matching (Hirschmueller, PAMI 2008)."""

import numpy as np
from numpy.typing import NDArray

Volume = NDArray[np.float32]

#: Cost of a step to the next depth, and of a jump to any other, for costs in [0, 2].
STEP_COST = 0.08
JUMP_COST = 0.5
#: Difference of two pixels in grey levels that halves the cost of a jump between them: depth ends at edges.
_EDGE_LEVELS = 8.0


def aggregate(cost: Volume, grey: NDArray[np.float32]) -> Volume:
    """Sum the cheapest ways to each depth along lines from the left, the right, above and below.

    Args:
        cost: ``(H, W, D)``.
        grey: ``(H, W)`` grey levels of the reference.

    Returns:
        ``(H, W, D)``, the sum over the four directions.
    """
    total = np.zeros_like(cost)
    down = _jump_cost(np.abs(np.diff(grey, axis=0)))
    _along(cost, down, total)
    _along(cost[::-1], down[::-1], total[::-1])
    across = np.ascontiguousarray(cost.transpose(1, 0, 2))
    total_across = np.zeros_like(across)
    right = _jump_cost(np.abs(np.diff(grey, axis=1))).T
    _along(across, right, total_across)
    _along(across[::-1], right[::-1], total_across[::-1])
    total += total_across.transpose(1, 0, 2)
    return total


def _jump_cost(difference: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.maximum(1.5 * STEP_COST, JUMP_COST / (1.0 + difference / _EDGE_LEVELS)).astype(np.float32)


def _along(cost: Volume, jump: NDArray[np.float32], total: Volume) -> None:
    """Add the cheapest ways from the first line on to ``total``.

    Args:
        cost: ``(L, N, D)``: lines of N pixels each, in the direction of travel.
        jump: ``(L - 1, N)`` cost of a jump between two lines.
        total: ``(L, N, D)``, added to.
    """
    way = cost[0].copy()
    total[0] += way
    for k in range(1, len(cost)):
        least = way.min(axis=-1, keepdims=True)
        best = np.minimum(way, least + jump[k - 1][:, None])
        np.minimum(best[:, 1:], way[:, :-1] + STEP_COST, out=best[:, 1:])
        np.minimum(best[:, :-1], way[:, 1:] + STEP_COST, out=best[:, :-1])
        way = cost[k] + (best - least)
        total[k] += way
