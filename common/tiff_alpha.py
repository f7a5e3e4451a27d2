"""Whether the colours of a TIFF come out of OpenCV with their transparency laid on already."""

import struct

_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_EXTRA_SAMPLES = 338
_ASSOCIATED, _UNASSOCIATED = 1, 2


def is_laid_on_black(data: bytes, bits: int) -> bool:
    """Tell whether OpenCV returns colours multiplied by alpha: black where all is transparent.

    A TIFF says which it holds. OpenCV gives values as they are stored; those of 8 bits pass through libtiff,
    which multiplies them.

    Args:
        data: The file; one that is no TIFF is not.
        bits: Of a value.
    """
    order = _ORDERS.get(data[:4])
    if order is None:
        return False
    try:
        (directory,) = struct.unpack_from(order + "I", data, 4)
        (num_tags,) = struct.unpack_from(order + "H", data, directory)
        tags = [struct.unpack_from(order + "HHIH", data, directory + 2 + 12 * k) for k in range(num_tags)]
    except struct.error:
        return False
    stored = next((value for tag, _, _, value in tags if tag == _EXTRA_SAMPLES), None)
    return stored == _ASSOCIATED or (stored == _UNASSOCIATED and bits == 8)
