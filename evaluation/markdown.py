"""Figures and tables as Markdown, and a generated part between two markers of a page."""

from collections.abc import Iterator, Sequence
from typing import Any


def number(value: Any, digits: int = 2) -> str:
    """Return a figure as text, a dash where there is none."""
    if value is None:
        return "-"
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def with_interval(value: float, low: float, high: float) -> str:
    """Return a figure and the interval it is in as text."""
    return f"{value:.2f} ({low:.2f} .. {high:.2f})"


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(str(cell) for cell in row) + " |"


def with_part(page: str, name: str, part: str) -> str:
    """Return a page with the lines between ``<!-- name -->`` and ``<!-- /name -->`` replaced.

    Raises:
        ValueError: A marker is missing.
    """
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    before, found_start, rest = page.partition(start)
    _, found_end, after = rest.partition(end)
    if not found_start or not found_end:
        raise ValueError(f"the page must hold {start} and {end}")
    return f"{before}{start}\n{part}\n{end}{after}"
