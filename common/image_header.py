"""The size an image states in its header, read without decoding it.

Whatever comes over the air is decoded only if it states no more pixels than there can be: a few kilobytes may
stand for gigabytes. So nothing is read in a way in which a decoder could read another size: what is unusual
states none.
"""

import io
import struct
from typing import BinaryIO

PNG_START = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
#: Start-of-frame markers are C0 to CF, but for these: Huffman tables, a reserved one, arithmetic coding.
_NO_FRAME_MARKERS = (0xC4, 0xC8, 0xCC)
#: Filling and markers that no length follows.
_BARE_MARKERS = (0x01, *range(0xD0, 0xDA), 0xFF)
#: A RIFF file: its length, "WEBP", the kind of the first chunk and its length.
_WEBP_DATA = 20


def png_size_wh(file: BinaryIO) -> tuple[int, int]:
    """Return the size a PNG states; ``struct.error`` where it is cut off."""
    # The header chunk comes first: its length, "IHDR", width and height.
    file.seek(len(PNG_START) + 8)
    width, height = struct.unpack(">II", file.read(8))
    return width, height


def jpeg_size_wh(file: BinaryIO) -> tuple[int, int] | None:
    """Return the size a JPEG states; ``struct.error`` where it is cut off, None where it is damaged."""
    file.seek(len(JPEG_START))
    while True:
        mark, marker, length = struct.unpack(">BBH", file.read(4))
        if mark != 0xFF or marker in _BARE_MARKERS or length < 2:
            return None
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME_MARKERS:
            _, height, width = struct.unpack(">BHH", file.read(5))
            return width, height
        file.seek(length - 2, 1)


def _webp_size_wh(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8 ":  # frame tag, start code, then 14 bits each and 2 of scaling
        width, height = struct.unpack_from("<HH", data, _WEBP_DATA + 6)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":  # a signature, then 14 bits each
        (bits,) = struct.unpack_from("<I", data, _WEBP_DATA + 1)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":  # flags, then 24 bits each
        sides = data[_WEBP_DATA + 4 : _WEBP_DATA + 10]
        if len(sides) == 6:
            return int.from_bytes(sides[:3], "little") + 1, int.from_bytes(sides[3:], "little") + 1
    return None


def _avif_size_wh(data: bytes) -> tuple[int, int] | None:
    """Return the largest of the sizes stated for the pictures of a file."""
    # Boxes follow each other: their length, their kind. Sizes are in "meta", the coded pictures elsewhere.
    begin, end, kind = 0, 0, b""
    while kind != b"meta":
        begin = end
        length, kind = struct.unpack_from(">I4s", data, begin)
        if length < 8:  # in 64 bits, or to the end of the file: not in a file as small as these
            return None
        end = begin + length
    sizes = []
    at = data.find(b"ispe", begin, end)  # image spatial extents: version and flags, width, height
    while at >= 0:
        sizes.append(struct.unpack_from(">II", data, at + 8))
        at = data.find(b"ispe", at + 4, end)
    if not sizes:
        return None
    return max(width for width, _ in sizes), max(height for _, height in sizes)


def stated_size_wh(data: bytes) -> tuple[int, int] | None:
    """Return the width and height that a PNG, JPEG, WebP or AVIF file states; None where there are none."""
    try:
        if data.startswith(PNG_START):
            return png_size_wh(io.BytesIO(data))
        if data.startswith(JPEG_START):
            return jpeg_size_wh(io.BytesIO(data))
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp_size_wh(data)
        return _avif_size_wh(data) if data[4:8] == b"ftyp" else None
    except struct.error:
        return None


def states_at_most(data: bytes, shape_hw: tuple[int, int]) -> bool:
    """Tell whether a file states a size, and one that is nowhere larger than ``shape_hw``."""
    size_wh = stated_size_wh(data)
    return size_wh is not None and size_wh[0] <= shape_hw[1] and size_wh[1] <= shape_hw[0]
