"""Where verbs print tables and lines, and show how far they are."""

import os
import re
import sys
from typing import IO, Any, TextIO, cast

from rich.console import Console
from rich.progress import Progress

#: Columns of what no terminal shows: lines of a file, or of what the next program reads, are not folded.
_WIDE = 1000


def plain_console(*, stderr: bool = False) -> Console:
    """Return a console that prints texts as they are.

    Names of files and messages of others may hold ``[brackets]`` and ``:colons:``, which rich would take for
    styles and pictures.
    """
    out = sys.stderr if stderr else sys.stdout
    is_shown = out is None or out.isatty() or "COLUMNS" in os.environ
    file = None if is_shown else cast("IO[str]", _Unpadded(out))
    width = None if is_shown else _WIDE
    return Console(file=file, stderr=stderr, markup=False, emoji=False, highlight=False, width=width)


class _Unpadded:
    """A stream without blanks at the ends of lines: tables fill all of theirs up to the longest."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def write(self, text: str) -> int:
        """Write the text; how many of its characters that were."""
        self._out.write(re.sub(r" +\n", "\n", text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._out, name)


def passing_progress() -> Progress:
    """Return a bar on stderr that is gone at the end; where nobody watches it would leave an empty line."""
    talk = plain_console(stderr=True)
    return Progress(console=talk, transient=True, disable=not talk.is_interactive)
