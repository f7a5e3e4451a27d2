"""Images that show nothing: a covered lens, a white-out, bare sky, a frame that was guessed from nothing."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.state import DecodedFrame, FrameResult, TrackingState

Array = NDArray[np.float64]

#: Side of the cells that are averaged: the noise of a sensor is gone then.
_CELL_PX = 8
#: Standard deviation of the cells' grey levels about a smooth shade below which there is nothing to see. A
#: view with a thirtieth of the usual contrast has more.
_LEAST_SD_GREY = 1.0
#: So few cells along a side say nothing about a shade.
_LEAST_CELLS = 6


def shows_nothing(image: NDArray[np.uint8]) -> bool:
    """Tell whether an ``(H, W, 3)`` image is even or shaded smoothly (to second order), up to noise."""
    height, width = image.shape[:2]
    size = (max(1, width // _CELL_PX), max(1, height // _CELL_PX))
    cells = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    grey = cells.mean(axis=2)
    if float(grey.std()) < _LEAST_SD_GREY:
        return True
    if min(grey.shape) < _LEAST_CELLS:
        return False
    shades, normal = _smooth_shades(grey.shape)
    shade = np.linalg.solve(normal, shades @ grey.ravel()) @ shades
    return float((grey.ravel() - shade).std()) < _LEAST_SD_GREY


@lru_cache(maxsize=8)
def _smooth_shades(shape_hw: tuple[int, int]) -> tuple[Array, Array]:
    """Shades ``(6, H W)`` that add up to every one of second order, and their products: one size a stream."""
    y, x = np.mgrid[-1.0 : 1.0 : shape_hw[0] * 1j, -1.0 : 1.0 : shape_hw[1] * 1j]
    shades = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]).reshape(6, -1)
    return shades, shades @ shades.T


def result_of_nothing(frame: DecodedFrame, state: TrackingState, map_epoch: int, submap: int) -> FrameResult:
    """Return the result of a frame that shows nothing: no pose, and nothing followed.

    The tracker stands as it stood: a camera is not lost because its lens was covered for a frame.
    """
    return FrameResult(
        frame_id=frame.frame_id,
        t_source_ns=frame.t_source_ns,
        state=state,
        T_world_cam=None,
        num_tracked=0,
        num_inliers=0,
        reprojection_error_px=None,
        covariance=None,
        is_keyframe=False,
        map_epoch=map_epoch,
        submap=submap,
        keypoints_xy=np.zeros((0, 2), np.float32),
        keypoint_inlier=np.zeros(0, bool),
    )
