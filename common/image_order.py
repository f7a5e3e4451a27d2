"""The order of image files by their names: numbers in them count as such, and times as times."""

import re
from collections.abc import Iterable
from pathlib import Path

#: Seconds since 1970 with their fraction, also behind a word.
_TIME = re.compile(r"((?:.*[^0-9])?[0-9]{9,}\.)([0-9]+)", re.DOTALL)
#: Digits of nanoseconds.
_FRACTION_DIGITS = 9


def natural_key(name: str) -> list[tuple[int, int | str]]:
    """Sort key by which ``r_2`` comes before ``r_10``."""
    parts = re.split(r"([0-9]+)", name)
    # Every second part is what the pattern caught; isdigit would also take signs that int can't read.
    return [(0, int(part)) if k % 2 else (1, part) for k, part in enumerate(parts) if part]


def in_order(images: Iterable[Path]) -> tuple[Path, ...]:
    """Return images in the natural order of their names; those that differ by leading zeros as texts.

    Where names are times of which zeros at the end are left out, as Python writes ``time.time()``, a fraction
    stands behind the point: ``1700000000.5`` comes after ``1700000000.25``. They are told from seconds and a
    whole number of nanoseconds by fractions that begin with a zero.
    """
    paths = sorted(images)
    times = [match for path in paths if (match := _TIME.fullmatch(path.stem)) is not None]
    has_fractions = any(match[2].startswith("0") and match[2] != "0" for match in times)
    if len(times) < len(paths) or not has_fractions:
        return tuple(sorted(paths, key=lambda path: natural_key(path.name)))
    keys = [natural_key(f"{match[1]}{match[2]:0<{_FRACTION_DIGITS}}") for match in times]
    return tuple(path for _, path in sorted(zip(keys, paths, strict=True)))
