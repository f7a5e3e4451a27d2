"""Where verbs print tables and lines, and show how far they are."""

import os
import sys

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
    width = None if is_shown else _WIDE
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, width=width)


def passing_progress() -> Progress:
    """Return a bar on stderr that is gone at the end; where nobody watches it would leave an empty line."""
    talk = plain_console(stderr=True)
    return Progress(console=talk, transient=True, disable=not talk.is_interactive)
