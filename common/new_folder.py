"""A folder for what a program writes, where it hits nothing that is there."""

import contextlib
import shutil
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

from semcast.common.errors import SourceError

#: In a folder while it is being filled; what is left of it says that nobody came to the end.
_UNFINISHED = ".unfinished"


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Make a folder, with those above it, to be filled in this context; an empty one may be there.

    Where that ends early, by an error, Ctrl-C or a request to end (SIGTERM), the folder is as it was, so
    that the next try may use it; those above it stay.

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
            with _ended_like_an_error():
                yield folder
            (folder / _UNFINISHED).unlink()
        except BaseException:
            _clear(folder, is_new)
            raise
    except OSError as err:
        raise SourceError(f"can't write to {folder}: {err.strerror}") from err


@contextlib.contextmanager
def _ended_like_an_error() -> Iterator[None]:
    """Let a request to end raise ``SystemExit`` in this context, which would end the process on the spot."""
    if threading.current_thread() is not threading.main_thread():  # the only one that may set handlers
        yield
        return

    def end(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _clear(folder: Path, is_new: bool) -> None:
    with contextlib.suppress(OSError):  # what went wrong before is what is to be said
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
        if is_new:
            folder.rmdir()
