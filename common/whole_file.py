"""Files that are the old one or the new one at any moment, and never half of one."""

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


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
