"""Text files of rows: fields between blanks or commas, a ``#`` begins a comment."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from semcast.common.errors import SourceError


class TextRow(NamedTuple):
    """A line that holds something.

    Attributes:
        number: Of the line, from 1.
        line: As it is.
        fields: At least one.
    """

    number: int
    line: str
    fields: list[str]


def text_rows(path: Path) -> Iterator[TextRow]:
    """Yield the rows of a file.

    Raises:
        SourceError: It can't be read, or is not UTF-8.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise SourceError(f"{path} can't be read: {err}") from err
    for number, line in enumerate(lines, start=1):
        if fields := line.split("#", 1)[0].replace(",", " ").split():
            yield TextRow(number, line, fields)
