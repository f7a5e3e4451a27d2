"""Squared distances between two sets of points of an image, all with all."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def square_distances(xy0: Array, xy1: Array) -> Array:
    """Squared distances ``(N, M)`` of ``(N, 2)`` points to ``(M, 2)`` others.

    Coordinate by coordinate: sums over a last axis of two cost several times as much.
    """
    dx = np.subtract.outer(xy0[:, 0], xy1[:, 0])
    dy = np.subtract.outer(xy0[:, 1], xy1[:, 1])
    return np.asarray(dx * dx + dy * dy)
