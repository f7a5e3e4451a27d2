"""The order of images by their names: numbers in them count as such, and times as times."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

#: Seconds since 1970 with their fraction, also behind other words, and the suffix of a file.
_TIME = re.compile(r"((?:.*[^0-9])?[0-9]{9,}\.)([0-9]+)(\.[A-Za-z]+)?", re.DOTALL)
#: Digits of nanoseconds.
_FRACTION_DIGITS = 9


def natural_key(name: str) -> list[tuple[int, int | str]]:
    """Sort key by which ``r_2`` comes before ``r_10``."""
    parts = re.split(r"([0-9]+)", name)
    # Every second part is what the pattern caught; isdigit would also take signs that int can't read.
    return [(0, int(part)) if k % 2 else (1, part) for k, part in enumerate(parts) if part]


def order_of(names: Sequence[str]) -> list[int]:
    """Return the indices of names in their natural order, those that are equal in it as they come.

    Where names are times of which zeros at the end are left out, as Python writes ``time.time()``, a fraction
    stands behind the point: ``1700000000.5`` comes after ``1700000000.25``. They are told from seconds and a
    whole number of nanoseconds by fractions that begin with a zero.
    """
    times = [match for name in names if (match := _TIME.fullmatch(name)) is not None]
    has_fractions = any(match[2].startswith("0") and match[2] != "0" for match in times)
    if len(times) == len(names) and has_fractions:
        names = [f"{match[1]}{match[2]:0<{_FRACTION_DIGITS}}" for match in times]
    keys = [natural_key(name) for name in names]
    return sorted(range(len(keys)), key=keys.__getitem__)


def in_order(images: Iterable[Path]) -> tuple[Path, ...]:
    """Return the images of a folder in the order of their names: the same on all machines."""
    paths = sorted(images)
    return tuple(paths[k] for k in order_of([path.name for path in paths]))
