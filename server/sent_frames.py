"""Which frames an agent sent, told by those that arrived: the others left gaps in their numbers.

An agent numbers what it sends. Frames of the source that it leaves out, for a server that can't keep up or
since newer ones came, have no number and count nowhere.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Stretch:
    """A frame that arrived, or all that were sent between two that did.

    Attributes:
        first_id: Its first frame's index in the source; of frames that never arrived as if evenly spaced.
        last_id: Its last frame's.
        num: Frames in it.
    """

    first_id: int
    last_id: int
    num: int

    @property
    def frame_ids(self) -> NDArray[np.int64]:
        """``(num,)`` of all of them."""
        return np.rint(np.linspace(self.first_id, self.last_id, self.num)).astype(np.int64)


def stretches(
    numbers: Mapping[int, int | None], *, from_first: bool = False, num_sent: int | None = None
) -> list[Stretch]:
    """Return what was sent up to the newest frame that arrived, or all that was, in order.

    Args:
        numbers: Frame id of each that arrived -> its number, counted from 0 and rising with the id; where one
            is None, all are taken to have been sent at their ids' common stride.
        from_first: Begin with frame number 0, whichever arrived first.
        num_sent: How many were sent in all, where that is known.
    """
    ids = sorted(numbers)
    steps = np.diff(np.array(ids, dtype=np.int64))
    seqs = [numbers[k] for k in ids]
    known = [seq for seq in seqs if seq is not None]
    if len(known) < len(seqs):
        num_sent = None  # nothing says which of those that were sent these are
        stride = max(1, int(np.gcd.reduce(steps)) if len(steps) else 1)
        known = [(k - ids[0]) // stride for k in ids]
    found: list[Stretch] = []
    if from_first and known and (num := min(known[0], ids[0])) > 0:
        found.append(Stretch(0, round(ids[0] - ids[0] / num), num))
    for k, frame_id in enumerate(ids):
        if k:
            gap = frame_id - ids[k - 1]
            # Frames have ids of their own, so there were no more than these leave room for.
            num = min(known[k] - known[k - 1], gap) - 1
            if num > 0:
                step = gap / (num + 1)
                found.append(Stretch(round(ids[k - 1] + step), round(frame_id - step), num))
        found.append(Stretch(frame_id, frame_id, 1))
    if num_sent is not None and (num := num_sent - (known[-1] + 1 if known else 0)) > 0:
        before = ids[-1] if ids else -1
        # As evenly spaced as those that arrived.
        step = (ids[-1] - ids[0]) / (known[-1] - known[0]) if len(known) > 1 else 1.0
        found.append(Stretch(round(before + step), round(before + num * step), num))
    return found


def unposed_ranges(sent: Sequence[Stretch], posed: set[int]) -> list[tuple[int, int]]:
    """Return first and last frame id of each run of frames that were sent and have no pose, in order."""
    ranges: list[tuple[int, int]] = []
    goes_on = False
    for stretch in sent:
        if stretch.num == 1 and stretch.first_id in posed:
            goes_on = False
            continue
        first = ranges.pop()[0] if goes_on else stretch.first_id
        ranges.append((first, stretch.last_id))
        goes_on = True
    return ranges
