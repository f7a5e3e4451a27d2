"""Square cells of an image by one number each, for sets of cells."""

import numpy as np
from numpy.typing import NDArray

#: More than there are rows of cells: no two cells of an image share a number.
_STRIDE = 1_000_003


def cell_keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of each cell, ``(N,)``, of its column and row ``(N, 2)``."""
    return np.asarray(cells[:, 0] * _STRIDE + cells[:, 1])
