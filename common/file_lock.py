"""Locks on files and folders that are being written. They go with the process, however that ends."""

import errno
import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def lock(descriptor: int) -> bool:
    """Lock an open file or folder until it is closed.

    Returns:
        False if another has locked it; True also where there are no locks (Windows, some network drives),
        and nothing keeps others out.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as err:
        return err.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True


def is_locked(path: Path) -> bool:
    """Tell whether somebody has locked a file; what is no file, or can't be opened, is not locked."""
    if not os.path.isfile(path):  # Path.is_file raises where it may not look
        return False
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        return not lock(descriptor)
    finally:
        os.close(descriptor)
