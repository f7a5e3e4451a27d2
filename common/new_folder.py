"""A folder for what a program writes, where it hits nothing that is there."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from semcast.common.errors import SourceError


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Make a folder, with those above it, to be filled in this context; an empty one may be there.

    Where that ends early, by an error or Ctrl-C, the folder is as it was, so that the next try may use it;
    those above it stay.

    Raises:
        SourceError: It has files in it, or can't be made or written to.
    """
    try:
        if folder.exists() and any(folder.iterdir()):
            raise SourceError(f"out must be a new or an empty folder, {folder} has files in it")
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            yield folder
        except BaseException:
            _clear(folder, is_new)
            raise
    except OSError as err:
        raise SourceError(f"can't write to {folder}: {err.strerror}") from err


def _clear(folder: Path, is_new: bool) -> None:
    with contextlib.suppress(OSError):  # what went wrong before is what is to be said
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
        if is_new:
            folder.rmdir()
