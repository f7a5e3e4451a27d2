"""What goes when a map has reached its limits, so that all places can still be recognised.

A camera comes back to where it was an hour ago as likely as to where it was a minute ago. What was seen
longest ago is therefore worth as much as the rest: keyframes get further apart everywhere, and each keeps
some of its landmarks.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]

#: Keyframes that share fewer tracks are on both sides of a gap.
_MIN_SHARED = 8


class Thinned(Protocol):
    """What is thinned out: keyframes."""

    @property
    def frame_id(self) -> int:
        """Of its frame."""

    @property
    def submap(self) -> int:
        """Which part of the map it belongs to."""

    @property
    def ids(self) -> Ids:
        """``(M,)`` tracks seen."""


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


def is_gap(before: Thinned, now: Thinned) -> bool:
    """Whether hardly a track goes from one keyframe to the one that came next."""
    return len(np.intersect1d(before.ids, now.ids, assume_unique=True)) < _MIN_SHARED


def gaps_among(keyframes: Sequence[Thinned], submap_of: Mapping[int, int]) -> set[int]:
    """Frame ids of the keyframes behind a gap, and of the first ones: a submap may be joined to another.

    Args:
        keyframes: Those that are left, in order of time.
        submap_of: Submap of every one there ever was; of two with others in between nothing is said.
    """
    ever: dict[int, list[int]] = {}
    for frame_id, submap in sorted(submap_of.items()):
        ever.setdefault(submap, []).append(frame_id)
    left = {k.frame_id: k for k in keyframes}
    steps = (step for mine in ever.values() for step in pairwise(mine))
    gaps = {now for before, now in steps if {before, now} <= left.keys() and is_gap(left[before], left[now])}
    return gaps | {mine[0] for mine in ever.values()}


def hung_on_what_is_left(
    revisits: Mapping[int, int], keyframes: Sequence[Thinned], submap_of: Mapping[int, int]
) -> dict[int, int]:
    """Let keyframes that were thinned out stand in a revisit for the kept one next in time.

    A revisit ties places by how they are now; without it the next loop would part them again.
    """
    kept = np.array([k.frame_id for k in keyframes])
    submap = np.array([k.submap for k in keyframes])

    def next_to(frame_id: int) -> int | None:
        near = kept[submap == submap_of[frame_id]]
        return int(near[np.argmin(np.abs(near - frame_id))]) if len(near) else None

    ends = [(next_to(new), next_to(old)) for new, old in revisits.items()]
    return {new: old for new, old in ends if new is not None and old is not None and new != old}
