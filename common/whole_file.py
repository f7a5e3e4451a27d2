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
        path: The file, or a pipe or device; folders that lack are made.
        name: Of the setting.

    Raises:
        ConfigError: It is a folder, or nothing can be written there.
    """
    if os.path.isdir(path):  # Path.is_dir raises where it may not look
        raise ConfigError(f"{name} must be a file, {path} is a folder")
    if _is_no_file(path) and os.access(path, os.W_OK):
        return
    folder = Path(os.path.realpath(path)).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except FileExistsError as err:
        raise ConfigError(f"{name} can't be written to {path}: {folder} is a file, not a folder") from err
    except OSError as err:
        raise ConfigError(f"{name} can't be written to {path}: {err.strerror}") from err


def write_whole(path: Path, content: str | bytes) -> None:
    """Write text, as UTF-8, or bytes to a file: all of it, or the file stays as it was.

    Raises:
        OSError: The file can't be written.
    """
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def _is_no_file(path: Path) -> bool:
    """Tell whether something is there that is neither a file nor a folder, such as ``/dev/stdout``."""
    return os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path)


@contextmanager
def whole_file(path: Path, *, durable: bool = False) -> Iterator[BinaryIO]:
    """Open a binary file that takes the place of ``path`` when the block ends, and vanishes when it raises.

    Args:
        path: In a folder that exists. A pipe or device is written as it is, and keeps its place; so does a
            link, whose file is written.
        durable: Have the content on the disk before it takes the place, for files that outlive a power cut.

    Raises:
        OSError: The file can't be written.
    """
    if _is_no_file(path):
        with path.open("wb") as file:
            yield file
        return
    path = Path(os.path.realpath(path))
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
