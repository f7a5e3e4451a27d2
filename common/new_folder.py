"""A folder for what a program writes, where it hits nothing that is there."""

from pathlib import Path

from semcast.common.errors import SourceError


def new_folder(folder: Path) -> Path:
    """Make a folder, with those above it, and return it; an empty one may be there.

    Raises:
        SourceError: It has files in it, or can't be made.
    """
    try:
        if folder.exists() and any(folder.iterdir()):
            raise SourceError(f"out must be a new or an empty folder, {folder} has files in it")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise SourceError(f"can't write to {folder}: {err.strerror}") from err
    return folder
