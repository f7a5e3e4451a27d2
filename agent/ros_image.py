"""Images of ROS messages as image files: compressed ones as they are, others as PNG."""

import re
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError
from semcast.common.image_file import decoded

#: Encoding of ``sensor_msgs/Image`` -> values a pixel, their type, OpenCV's way to BGR where one is needed.
_ENCODINGS: dict[str, tuple[int, type, int | None]] = {
    "mono8": (1, np.uint8, None),
    "8UC1": (1, np.uint8, None),
    "mono16": (1, np.uint16, None),
    "bgr8": (3, np.uint8, None),
    "8UC3": (3, np.uint8, None),
    "rgb8": (3, np.uint8, cv2.COLOR_RGB2BGR),
    "bgra8": (4, np.uint8, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, np.uint8, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, np.uint8, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, np.uint8, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, np.uint8, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, np.uint8, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, np.uint8, cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": (1, np.uint16, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr16": (1, np.uint16, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg16": (1, np.uint16, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg16": (1, np.uint16, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, np.uint8, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, np.uint8, cv2.COLOR_YUV2BGR_YUY2),
    "nv12": (1, np.uint8, cv2.COLOR_YUV2BGR_NV12),
    "nv21": (1, np.uint8, cv2.COLOR_YUV2BGR_NV21),
}
#: Below their brightness lie half as many rows of colour, of four pixels each.
_WITH_ROWS_OF_COLOUR = ("nv12", "nv21")
#: First bytes of a file -> its suffix.
_MAGIC = ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n\x1a\n", ".png"), (b"RIFF", ".webp"))


class RawImage(Protocol):
    """``sensor_msgs/Image``."""

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: NDArray[np.uint8]


class CompressedImage(Protocol):
    """``sensor_msgs/CompressedImage``."""

    format: str
    data: NDArray[np.uint8]


def raw_image_file(message: RawImage) -> tuple[str, bytes]:
    """Return suffix and content of a PNG of an uncompressed image.

    Raises:
        SourceError: The encoding is none of a camera, or the size is none that it can have, or not that of
            the data.
    """
    encoding = message.encoding
    if encoding not in _ENCODINGS:
        what = " (a depth image?)" if encoding in ("16UC1", "32FC1") else ""
        raise SourceError(f"encoding must be one of {', '.join(_ENCODINGS)}, got {encoding!r}{what}")
    num_values, value_type, way = _ENCODINGS[encoding]
    item = np.dtype(value_type).newbyteorder(">" if message.is_bigendian else "<")
    row_bytes = message.width * num_values * item.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    has_rows_of_colour = encoding in _WITH_ROWS_OF_COLOUR
    # Two pixels share their colour, or four.
    if (num_values == 2 or has_rows_of_colour) and message.width % 2:
        raise SourceError(f"an image of {encoding} must have an even width, got {message.width}")
    if has_rows_of_colour and message.height % 2:
        raise SourceError(f"an image of {encoding} must have an even height, got {message.height}")
    num_rows = message.height * 3 // 2 if has_rows_of_colour else message.height
    if min(message.width, message.height) < 1 or message.step < row_bytes:
        raise SourceError(
            f"an image of {message.width}x{message.height} {encoding} must have rows of at least "
            f"{row_bytes} bytes, got {message.step}"
        )
    if len(data) != message.step * num_rows:
        raise SourceError(
            f"{num_rows} rows of {message.step} bytes must be {message.step * num_rows} bytes, "
            f"got {len(data)}"
        )
    rows = np.ascontiguousarray(data.reshape(num_rows, message.step)[:, :row_bytes])
    pixels: NDArray = rows.view(item).astype(value_type).reshape(num_rows, message.width, num_values)
    return _png(_coloured(pixels, way))


def compressed_image_file(message: CompressedImage) -> tuple[str, bytes]:
    """Return suffix and content of an image file that is what was sent, unless its colours are a mosaic.

    Raises:
        SourceError: It is neither JPEG, PNG nor WebP.
    """
    data = np.asarray(message.data, dtype=np.uint8).tobytes()
    suffix = next((suffix for magic, suffix in _MAGIC if data.startswith(magic)), None)
    if suffix is None or "compressedDepth" in message.format:
        raise SourceError(f"compressed images must be JPEG, PNG or WebP pictures, got {message.format!r}")
    mosaic = re.search(r"compressed (bayer_\w+8)$", message.format.strip())
    if mosaic is None:
        return suffix, data
    pixels = decoded(np.frombuffer(data, dtype=np.uint8))
    if pixels is None or pixels.ndim != 2 or mosaic[1] not in _ENCODINGS:
        raise SourceError(f"an image of format {message.format!r} must be grey, and is not")
    return _png(_coloured(pixels, _ENCODINGS[mosaic[1]][2]))


def _coloured(pixels: NDArray, way: int | None) -> NDArray:
    return pixels if way is None else np.asarray(cv2.cvtColor(pixels, way))


def _png(pixels: NDArray) -> tuple[str, bytes]:
    is_written, png = cv2.imencode(".png", pixels)
    if not is_written:
        raise SourceError(f"an image of shape {pixels.shape} can't be written as PNG")
    return ".png", png.tobytes()
