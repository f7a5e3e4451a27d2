"""Size and bits of an image file without decoding it, where its format makes that easy."""

import struct
from pathlib import Path
from typing import BinaryIO

from semcast.common.image_header import JPEG_START, PNG_START, jpeg_size_wh, png_size_wh

#: Where a PNG states its bits a value: behind length and kind of the header chunk, width and height.
_PNG_BITS = len(PNG_START) + 16
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"


def size_in_header_wh(path: Path) -> tuple[int, int] | None:
    """Return the width and height that a PNG or JPEG file states.

    None for other formats, for a file that can't be read, and for one that does not end as it should: only
    decoding tells then.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(PNG_START))
            if start == PNG_START and _ends_with(file, _PNG_END):
                return png_size_wh(file)
            if start.startswith(JPEG_START) and _ends_with(file, _JPEG_END):
                return jpeg_size_wh(file)
    except (OSError, ValueError, struct.error):  # a path with a NUL in it is a ValueError
        return None
    return None


def states_16_bits(path: Path) -> bool:
    """Tell whether a file is a PNG with 16 bits a value."""
    try:
        with path.open("rb") as file:
            start = file.read(_PNG_BITS + 1)
    except OSError:
        return False
    return start.startswith(PNG_START) and start[_PNG_BITS:] == b"\x10"


def _ends_with(file: BinaryIO, end: bytes) -> bool:
    file.seek(-len(end), 2)
    return file.read() == end
