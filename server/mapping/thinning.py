"""What goes when a map has reached its limits, so that all places can still be recognised.

A camera comes back to where it was an hour ago as likely as to where it was a minute ago. What was seen
longest ago is therefore worth as much as the rest: keyframes get further apart everywhere, and each keeps
some of its landmarks.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]


def evenly_thinned(frame_ids: Ids, count: int) -> NDArray[np.intp]:
    """Rows of ``frame_ids (N,)``, ascending, to keep: ``count`` of them, as far apart as they can be."""
    rows = np.arange(len(frame_ids))
    while len(rows) > max(count, 2):
        kept = frame_ids[rows]
        rows = np.delete(rows, 1 + int(np.argmin(kept[2:] - kept[:-2])))
    return rows[:count]


def least_needed(seen: Sequence[NDArray[np.intp]], last_seen: Ids, recent_since: int, count: int) -> Ids:
    """Rows of the landmarks to forget, so that each keyframe keeps about as many.

    First those go that no keyframe sees: nothing finds them again. Then those of the keyframes that have the
    most, a landmark being of the last one that sees it, and of these the ones that fewest keyframes see.
    Landmarks of late stay as long as possible, the last seen longest: the next frames rest on them.

    Args:
        seen: For each keyframe, oldest first, the rows of the landmarks it sees.
        last_seen: ``(N,)`` frame in which each landmark was last seen.
        recent_since: Landmarks seen from this frame on are of late.
        count: How many go.
    """
    num_views = np.zeros(len(last_seen), np.int64)
    home = np.full(len(last_seen), -1)
    for keyframe, rows in enumerate(seen):
        num_views[rows] += 1
        home[rows] = keyframe
    order = np.lexsort((-num_views, home))
    _, first, inverse = np.unique(home[order], return_index=True, return_inverse=True)
    rank = np.zeros(len(last_seen), np.int64)
    rank[order] = np.arange(len(order)) - first[inverse]
    rank[home < 0] = len(last_seen)
    of_late = last_seen >= recent_since
    rank[of_late] = 0
    return np.lexsort((last_seen, -rank, of_late))[:count]
