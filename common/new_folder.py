"""A folder for what a program writes, where it hits nothing that is there."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from semcast.common.errors import SourceError
from semcast.common.interrupts import ending_signals, signals_handled

#: In a folder while it is being filled; what is left of it says that nobody came to the end.
_UNFINISHED = ".unfinished"


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Make a folder, with those above it, to be filled in this context; an empty one may be there.

    Where that ends early, by an error, Ctrl-C, a request to end (SIGTERM) or a hang-up, the folder is as it
    was, so that the next try may use it; those above it stay.

    Raises:
        SourceError: It has files in it, or can't be made or written to.
    """
    try:
        if folder.exists() and any(folder.iterdir()):
            unfinished = (folder / _UNFINISHED).exists()
            what = (
                "an unfinished sequence in it: delete it, if no run is writing it"
                if unfinished
                else "files in it"
            )
            raise SourceError(f"out must be a new or an empty folder, {folder} has {what}")
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            (folder / _UNFINISHED).touch()
            with signals_handled(ending_signals(), _exit):
                yield folder
            (folder / _UNFINISHED).unlink()
        except BaseException:
            _clear(folder, is_new)
            raise
    except OSError as err:
        raise SourceError(f"can't write to {folder}: {err.strerror}") from err


def _exit(number: int, _frame: object) -> NoReturn:
    """End like an error, and not on the spot as a signal does."""
    raise SystemExit(128 + number)


def _clear(folder: Path, is_new: bool) -> None:
    with contextlib.suppress(OSError):  # what went wrong before is what is to be said
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
        if is_new:
            folder.rmdir()
