"""Tells the parts of a bag, as ROS 1 splits one, from bags that have nothing to do with each other."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from semcast.common.errors import SourceError

#: ``rosbag record --split`` ends names with the time at which a part begins, and its number.
_TIME = re.compile(r"\d{4}(-\d\d){5}")
_NUMBERED = re.compile(r"(.*?)(\d+)", re.DOTALL)
#: A part begins where the one before ends; messages that arrive together may be written in another order.
_OVERLAP_NS = 10**9
#: A recording that stood still for longer is another one.
_GAP_NS = 60 * 10**9


def in_order(parts: Sequence[Path]) -> list[Path]:
    """Return the parts of a bag by their numbers.

    Raises:
        SourceError: Their names don't say that they are those of one.
    """
    if len(parts) == 1:
        return list(parts)
    numbers: dict[tuple[str, int], Path] = {}
    for part in parts:
        match = _NUMBERED.fullmatch(_TIME.sub("", part.stem))
        if match is None:
            raise _unrelated(parts, f"{part.name} has no number")
        stem, number = match[1], int(match[2])
        if (stem, number) in numbers:
            raise _unrelated(parts, f"{numbers[stem, number].name} and {part.name} have the same number")
        numbers[stem, number] = part
    if len({stem for stem, _ in numbers}) > 1:
        first, *_, last = sorted(numbers)
        raise _unrelated(
            parts, f"{numbers[first].name} and {numbers[last].name} differ by more than a number"
        )
    return [numbers[key] for key in sorted(numbers)]


def check_times(parts: Sequence[Path], spans_ns: Sequence[tuple[int, int]]) -> None:
    """Make sure that each part of a bag begins about where the one before ends.

    Args:
        parts: In order.
        spans_ns: Of each, when its first and its last message were recorded; the first is later than the last
            where there is none.

    Raises:
        SourceError: They do not.
    """
    recorded = [(part, *span) for part, span in zip(parts, spans_ns, strict=True) if span[0] <= span[1]]
    for (before, _, end_ns), (after, start_ns, _) in pairwise(recorded):
        gap_ns = start_ns - end_ns
        if not -_OVERLAP_NS <= gap_ns <= _GAP_NS:
            when = f"{gap_ns * 1e-9:.1f} s after" if gap_ns > 0 else f"{-gap_ns * 1e-9:.1f} s before"
            raise _unrelated(parts, f"{after.name} begins {when} the end of {before.name}")


def _unrelated(parts: Sequence[Path], why: str) -> SourceError:
    return SourceError(f"the bags in {parts[0].parent} are not the parts of one: {why}; name one of them")
