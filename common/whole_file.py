"""Files that are the old one or the new one at any moment, and never half of one."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from semcast.common.errors import ConfigError


def check_writable(path: Path, name: str) -> None:
    """Refuse a file that could not be written, before the work whose result it is to hold.

    Args:
        path: The file; folders that lack are made.
        name: Of the setting.

    Raises:
        ConfigError: It is a folder, or nothing can be written there.
    """
    if os.path.isdir(path):  # Path.is_dir raises where it may not look
        raise ConfigError(f"{name} must be a file, {path} is a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as err:
        raise ConfigError(f"{name} can't be written to {path}: {err.strerror}") from err


@contextmanager
def whole_file(path: Path, *, durable: bool = False) -> Iterator[BinaryIO]:
    """Open a binary file that takes the place of ``path`` when the block ends, and vanishes when it raises.

    Args:
        path: In a folder that exists.
        durable: Have the content on the disk before it takes the place, for files that outlive a power cut.

    Raises:
        OSError: The file can't be written.
    """
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("w+b") as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
