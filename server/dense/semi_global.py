"""Smoothing of a cost volume along lines of pixels: semi-global matching (Hirschmueller, PAMI 2008)."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.plane_sweep import UNKNOWN_COST

Volume = NDArray[np.uint8]
Smoothed = NDArray[np.uint16]

#: Lines of pixels that the costs of a pixel are summed over.
NUM_DIRECTIONS = 4
#: Cost of a step to the next depth, and of a jump to any other. The dearest way fits in a byte.
STEP_COST = 8
JUMP_COST = 140
assert np.iinfo(np.uint8).max >= UNKNOWN_COST + JUMP_COST + STEP_COST
#: Difference of two pixels in grey levels that halves the cost of a jump between them: depth ends at edges.
_EDGE_LEVELS = 8.0


def aggregate(cost: Volume, grey: NDArray[np.float32]) -> Smoothed:
    """Sum the cheapest ways to each depth along lines from the left, the right, above and below.

    Args:
        cost: ``(D, H, W)``, at most ``UNKNOWN_COST``.
        grey: ``(H, W)`` grey levels of the reference.

    Returns:
        ``(H, W, D)``, the sum over the four directions.
    """
    rows = np.ascontiguousarray(cost.transpose(1, 2, 0))
    total = np.zeros(rows.shape, np.uint16)
    down = _jump_cost(np.abs(np.diff(grey, axis=0)))
    _along(rows, down, total)
    _along(rows[::-1], down[::-1], total[::-1])
    columns = np.ascontiguousarray(cost.transpose(2, 1, 0))
    total_across = np.zeros(columns.shape, np.uint16)
    right = _jump_cost(np.abs(np.diff(grey, axis=1))).T
    _along(columns, right, total_across)
    _along(columns[::-1], right[::-1], total_across[::-1])
    total += total_across.transpose(1, 0, 2)
    return total


def _jump_cost(difference: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.maximum(1.5 * STEP_COST, JUMP_COST / (1.0 + difference / _EDGE_LEVELS)).astype(np.uint8)


def _along(cost: Volume, jump: NDArray[np.uint8], total: Smoothed) -> None:
    """Add the cheapest ways from the first line on to ``total``.

    Args:
        cost: ``(L, N, D)``: lines of N pixels each, in the direction of travel.
        jump: ``(L - 1, N)`` cost of a jump between two lines.
        total: ``(L, N, D)``, added to.
    """
    way = cost[0].copy()
    total[0] += way
    step = np.uint8(STEP_COST)
    for k in range(1, len(cost)):
        way -= way.min(axis=-1, keepdims=True)
        best = np.minimum(way, jump[k - 1][:, None])
        way += step
        np.minimum(best[:, 1:], way[:, :-1], out=best[:, 1:])
        np.minimum(best[:, :-1], way[:, 1:], out=best[:, :-1])
        best += cost[k]
        way = best
        total[k] += way
