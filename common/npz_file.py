"""A header and arrays in one ``.npz`` file: written whole, read without executing what is in it."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.whole_file import whole_file

#: Name of the array that holds the header, as JSON in uint8.
HEADER = "header"


def write_npz(
    path: Path,
    header: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    *,
    compressed: bool,
    durable: bool = False,
) -> None:
    """Write a header and arrays, all of them, or the file stays as it was; folders that lack are made.

    Args:
        path: The file.
        header: What JSON can hold.
        arrays: By name, none of which is ``HEADER``.
        compressed: Take longer and less room.
        durable: Have it on the disk before it takes the place, see ``whole_file``.

    Raises:
        OSError: The file can't be written.
        ValueError: An array holds objects, which only a pickle could.
    """
    content: dict[str, Any] = {HEADER: np.frombuffer(json.dumps(header).encode(), dtype=np.uint8), **arrays}
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, durable=durable) as file:
        (np.savez_compressed if compressed else np.savez)(file, allow_pickle=False, **content)


def read_npz(path: Path, max_bytes: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return header and arrays of a file.

    Args:
        path: The file.
        max_bytes: Larger ones, also when unpacked, are refused before any of it is taken into memory.

    Raises:
        OSError: The file can't be read.
        ValueError: It is damaged, holds objects, is too large or has no header; the message goes on behind
            the file's name.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = max(path.stat().st_size, sum(member.file_size for member in archive.infolist()))
        if size <= max_bytes:
            with np.load(path, allow_pickle=False) as content:
                arrays = {name: np.array(content[name]) for name in content.files}
            header = dict(json.loads(arrays.pop(HEADER).tobytes()))
    except OSError:
        raise
    except Exception as err:  # a damaged zip or array fails in many ways
        raise ValueError(f"is damaged: {err}") from err
    if size > max_bytes:
        raise ValueError(f"must unpack to at most {max_bytes} bytes, got {size}")
    return header, arrays
