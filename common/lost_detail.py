"""What coding a picture at a smaller size adds to the errors that its confidence stands for.

A decoder knows what the link did to the picture it was sent, not what scaling down and up again takes from
the camera's. How much that is shows in the decoded picture: what the same scaling would take from it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import LABEL_SHARPNESS
from semcast.common.image import scaled_wh

Map = NDArray[np.float32]

#: Error at the camera's size over that at the coded one, and over the detail that scaling takes from the
#: decoded picture. Fitted to training photos by ``semcast.evaluation.lost_detail``.
ERROR_FACTORS = (1.06, 0.2)
#: Side of the window over which the detail is averaged, in pixels of the coded picture.
_WINDOW_PX = 9
#: Confidence 0 stands for no finite error.
_MOST_DOUBT = 0.9995


def detail_at(image: NDArray[np.uint8], ratio: float) -> Map:
    """Return what scaling a picture down and up again takes from it.

    Args:
        image: ``(H, W, 3)`` uint8.
        ratio: Of the smaller size to that of the picture, below 1.

    Returns:
        ``(H, W)`` mean absolute difference over colour and over a window, in shares of white.
    """
    height, width = image.shape[:2]
    small = cv2.resize(image, scaled_wh(width, height, ratio), interpolation=cv2.INTER_AREA)
    again = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    lost = cv2.absdiff(image, again).astype(np.float32).mean(axis=2) / np.float32(255.0)
    return np.asarray(cv2.blur(lost, (_WINDOW_PX, _WINDOW_PX)), np.float32)


def scaled_errors(confidence: Map, detail: Map) -> Map:
    """Return what ``ERROR_FACTORS`` weigh: ``(2, H, W)`` errors times the sharpness of the label."""
    at_coded = np.arctanh(np.minimum(1.0 - confidence, np.float32(_MOST_DOUBT)))
    return np.stack([at_coded, np.float32(LABEL_SHARPNESS) * detail])


def confidence_at_camera(confidence: Map, image: NDArray[np.uint8], ratio: float) -> Map:
    """Return the confidence of a picture that will be scaled up; never more than at the coded size.

    Args:
        confidence: ``(H, W)`` in [0, 1], of the coded picture.
        image: ``(H, W, 3)`` uint8, the decoded picture.
        ratio: Of the coded size to the camera's, below 1.
    """
    errors = scaled_errors(confidence, detail_at(image, ratio))
    summed = np.tensordot(np.array(ERROR_FACTORS, np.float32), errors, axes=1)
    return np.asarray(np.minimum(confidence, 1.0 - np.tanh(summed)), np.float32)
