"""Where verbs print tables and lines."""

from rich.console import Console


def plain_console(*, stderr: bool = False) -> Console:
    """Return a console that prints texts as they are.

    Names of files and messages of others may hold ``[brackets]`` and ``:colons:``, which rich would take for
    styles and pictures.
    """
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)
