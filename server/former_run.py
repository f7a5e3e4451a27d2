"""What an earlier run left in an output folder: known by its rows, out of the way before a new run begins."""

import contextlib
import logging
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from semcast.common.errors import ConfigError
from semcast.common.file_lock import lock
from semcast.common.run_folder import (
    FRAMES_NAME,
    IMAGES_NAME,
    RUN_FILES,
    TRAJECTORY_NAME,
    read_image_paths,
)

logger = logging.getLogger(__name__)


def is_run(folder: Path) -> bool:
    """Whether a run has written into a folder; else all in it, a recorded sequence perhaps, is not ours."""
    rows = folder / FRAMES_NAME
    return rows.is_file() and (rows.stat().st_size > 0 or (folder / TRAJECTORY_NAME).exists())


def check_not_foreign(folder: Path, name: str) -> None:
    """Refuse a folder that holds something under a name of ours which no run wrote.

    Args:
        folder: Output folder of a run that is to begin.
        name: File or folder in it that the run would write.

    Raises:
        ConfigError: It is there, and the folder is no run's.
    """
    there = folder / name
    is_there = any(there.iterdir()) if there.is_dir() else there.exists()
    if is_there and not is_run(folder):
        raise ConfigError(f"out must not hold {name} that no run wrote, {folder} does: give another folder")


def make_output_folder(folder: Path) -> None:
    """Make the folder a run is to write into, or refuse it.

    Images are looked at also where the run keeps none: a later one in the same folder would take those of
    somebody else for its own.

    Raises:
        ConfigError: It can't be made or written into, or holds images that no run wrote.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as err:
        raise ConfigError(f"{folder} can't be made a folder for outputs: {err}") from err
    check_not_foreign(folder, IMAGES_NAME)


@contextlib.contextmanager
def output_folder(folder: Path | None) -> Iterator[None]:
    """Make the folder a run is to write into, and keep other runs out of it until the block ends.

    The lock is on the folder itself and goes with the process, however that ends. Where there are no locks
    (Windows, some network drives) nothing keeps others out.

    Args:
        folder: The folder, or None for a run that writes nothing.

    Raises:
        ConfigError: It can't be made or written into, holds images that no run wrote, or a run is writing
            into it.
    """
    if folder is None:
        yield
        return
    make_output_folder(folder)
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        yield
        return
    try:
        if not lock(descriptor):
            raise ConfigError(f"out must not be in use, another run is writing into {folder}")
        yield
    finally:
        os.close(descriptor)


def free_folder(folder: Path) -> Path:
    """Return ``previous-<n>`` in a folder, the first that is not there."""
    n = 1
    while os.path.lexists(folder / f"previous-{n}"):  # Path.exists raises where it may not look
        n += 1
    return folder / f"previous-{n}"


def set_aside(folder: Path) -> None:
    """Move what an earlier run left into ``previous-<n>``; what can't be moved is told and stays."""
    try:
        if not is_run(folder):
            return
        kept = free_folder(folder)
        kept.mkdir()
        for name in (*RUN_FILES, IMAGES_NAME):
            if (folder / name).exists():
                (folder / name).rename(kept / name)
    except OSError as err:
        logger.warning("what an earlier run left in %s can't be set aside: %s", folder, err)
    else:
        logger.info("what an earlier run left in %s is kept in %s", folder, kept.name)


def discard(folder: Path) -> None:
    """Remove what an earlier run left.

    Raises:
        ConfigError: It can't be removed.
    """
    if not is_run(folder):
        return
    try:
        for old in (*(folder / name for name in RUN_FILES), *read_image_paths(folder).values()):
            old.unlink(missing_ok=True)
    except OSError as err:
        raise ConfigError(f"what an earlier run left in {folder} can't be removed: {err}") from err
