"""Where ids of tracks, which are those of landmarks, stand among others."""

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]
Rows = NDArray[np.intp]


def rows_among(ids: Ids, others: Ids) -> Rows:
    """Return the row of each id among others, which are ascending; -1 for one that is not there."""
    if len(others) == 0:
        return np.full(len(ids), -1, dtype=np.intp)
    row = np.minimum(np.searchsorted(others, ids), len(others) - 1)
    return np.asarray(np.where(others[row] == ids, row, -1), dtype=np.intp)


def shared_rows(ids0: Ids, ids1: Ids) -> tuple[Rows, Rows]:
    """Return the rows of the ids that two sets share, in either set, by ascending id; each has an id once."""
    _, row0, row1 = np.intersect1d(ids0, ids1, assume_unique=True, return_indices=True)
    return row0, row1
