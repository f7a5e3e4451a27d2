"""Size of an image file without decoding it, where its format makes that easy."""

import struct
from pathlib import Path
from typing import BinaryIO

_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
#: Start-of-frame markers are C0 to CF, but for these: Huffman tables, a reserved one, arithmetic coding.
_NO_FRAME_MARKERS = (0xC4, 0xC8, 0xCC)


def size_in_header_wh(path: Path) -> tuple[int, int] | None:
    """Return the width and height that a PNG or JPEG file states.

    None for other formats, for a file that can't be read, and for one that does not end as it should: only
    decoding tells then.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(_PNG_START))
            if start == _PNG_START and _ends_with(file, _PNG_END):
                return _png_size_wh(file)
            if start.startswith(_JPEG_START) and _ends_with(file, _JPEG_END):
                return _jpeg_size_wh(file)
    except (OSError, struct.error):
        return None
    return None


def _ends_with(file: BinaryIO, end: bytes) -> bool:
    file.seek(-len(end), 2)
    return file.read() == end


def _png_size_wh(file: BinaryIO) -> tuple[int, int]:
    # The header chunk comes first: its length, "IHDR", width and height.
    file.seek(len(_PNG_START) + 8)
    width, height = struct.unpack(">II", file.read(8))
    return width, height


def _jpeg_size_wh(file: BinaryIO) -> tuple[int, int] | None:
    file.seek(len(_JPEG_START))
    while True:
        mark, marker, length = struct.unpack(">BBH", file.read(4))
        if mark != 0xFF:
            return None
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME_MARKERS:
            _, height, width = struct.unpack(">BHH", file.read(5))
            return width, height
        file.seek(length - 2, 1)
