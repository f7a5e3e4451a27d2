"""The newest image as viewers get it: compressed once for all of them, with its confidence in colours."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.view.frame_view import FrameView

MAX_KEYPOINTS = 1500
#: From confidence 0 to 1 in equal steps; bright at both ends, for points on a dark background.
CONFIDENCE_COLOURS = ((165, 30, 75), (235, 95, 60), (250, 205, 90), (90, 220, 160), (40, 200, 220))


@dataclass(frozen=True)
class Picture:
    """The newest image, compressed once for all viewers."""

    frame_id: int
    t_source_ns: int
    image_jpeg: bytes
    confidence_jpeg: bytes | None
    keypoints_xy: NDArray[np.float32]
    keypoint_inlier: NDArray[np.bool_]


def compress_picture(view: FrameView, quality: int) -> Picture:
    """Compress a frame's image and colour-mapped confidence to JPEG and thin out its keypoints.

    Raises:
        ValueError: The view has no image.
    """
    if view.image is None:
        raise ValueError(f"frame {view.frame_id} must have an image")
    bgr = cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    image_jpeg = cv2.imencode(".jpg", bgr, options)[1].tobytes()
    confidence_jpeg = None
    if view.confidence is not None:
        heat = cv2.cvtColor(confidence_colours(view.confidence), cv2.COLOR_RGB2BGR)
        confidence_jpeg = cv2.imencode(".jpg", heat, options)[1].tobytes()
    step = -(-max(len(view.keypoints_xy), 1) // MAX_KEYPOINTS)
    return Picture(
        view.frame_id,
        view.t_source_ns,
        image_jpeg,
        confidence_jpeg,
        view.keypoints_xy[::step],
        view.keypoint_inlier[::step],
    )


def confidence_colours(confidence: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colour confidences of any shape: red is not trusted, yellow half, turquoise fully; NaN counts as 0.

    Returns:
        uint8 RGB with one more axis, of length 3.
    """
    levels = (np.clip(np.nan_to_num(confidence, nan=0.0), 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.asarray(np.take(_colour_table(), levels, axis=0), dtype=np.uint8)


@functools.cache
def _colour_table() -> NDArray[np.uint8]:
    """Return the colour of each of 256 levels, ``(256, 3)`` RGB."""
    stops = np.linspace(0.0, 255.0, len(CONFIDENCE_COLOURS))
    channels = [np.interp(np.arange(256), stops, channel) for channel in np.transpose(CONFIDENCE_COLOURS)]
    return np.asarray(np.rint(np.stack(channels, axis=1)), dtype=np.uint8)
