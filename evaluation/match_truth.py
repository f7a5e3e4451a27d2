"""Which matches are right: distance to the true epipolar lines, and to the track in the original images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.codec import KLT_WINDOW_PX
from semcast.common.geometry import make_transform
from semcast.server.geometry.epipolar import fundamental_matrix, sampson_px

Array = NDArray[np.float64]

#: Pyramid of the tracks that serve as truth.
_LK_LEVELS = 3


def epipolar_distance_px(
    keypoints0_xy: Array, keypoints1_xy: Array, T_cam1_cam0: Array, camera: Intrinsics
) -> Array:
    """Return the Sampson distance of matches to the epipolar geometry of a motion.

    Args:
        keypoints0_xy: ``(N, 2)`` pixels in the first image.
        keypoints1_xy: ``(N, 2)`` pixels in the second image.
        T_cam1_cam0: True motion, 4x4.
        camera: Both images' camera, without distortion.

    Returns:
        ``(N,)`` pixels, first order (Hartley and Zisserman, Eq. 11.9), inf where a turn alone has no lines.
    """
    length = float(np.linalg.norm(T_cam1_cam0[:3, 3]))
    if length == 0.0:
        return np.full(len(keypoints0_xy), np.inf)
    F = fundamental_matrix(camera, make_transform(T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3] / length))
    return np.abs(sampson_px(F, keypoints0_xy, keypoints1_xy))


def track_points(
    image0: NDArray[np.uint8], image1: NDArray[np.uint8], points_xy: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Follow points from one RGB image to another by pyramidal Lucas-Kanade.

    Args:
        image0: ``(H, W, 3)`` uint8 RGB.
        image1: ``(H, W, 3)`` uint8 RGB.
        points_xy: ``(N, 2)`` pixels in ``image0``.

    Returns:
        ``(N, 2)`` pixels in ``image1`` and ``(N,)`` bool, False where the point was lost.
    """
    if len(points_xy) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    grey0, grey1 = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (image0, image1))
    start = np.ascontiguousarray(points_xy, dtype=np.float32).reshape(-1, 1, 2)
    moved_xy, found, _ = cv2.calcOpticalFlowPyrLK(
        grey0,
        grey1,
        start,
        start.copy(),
        winSize=(KLT_WINDOW_PX, KLT_WINDOW_PX),
        maxLevel=_LK_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    moved_xy, found = np.asarray(moved_xy), np.asarray(found)
    return moved_xy.reshape(-1, 2).astype(np.float64), found.ravel().astype(bool)


def displacement_from_original_px(
    decoded: NDArray[np.uint8], original: NDArray[np.uint8], points_xy: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return how far each point's surroundings lie from where they are in the original image.

    Args:
        decoded: ``(H, W, 3)`` uint8 RGB.
        original: ``(H, W, 3)`` uint8 RGB of the same moment.
        points_xy: ``(N, 2)`` pixels in ``decoded``.

    Returns:
        ``(N,)`` pixels, and ``(N,)`` bool: False where Lucas-Kanade lost the point.
    """
    moved_xy, found = track_points(decoded, original, points_xy)
    return np.linalg.norm(moved_xy - points_xy, axis=1), found


def track_error_px(
    keypoints0_xy: Array, keypoints1_xy: Array, original0: NDArray[np.uint8], original1: NDArray[np.uint8]
) -> Array:
    """Return how far a decoded track ends from the track of the same start in the original images.

    Args:
        keypoints0_xy: ``(N, 2)`` starts of the tracks.
        keypoints1_xy: ``(N, 2)`` ends of the tracks on decoded images.
        original0: ``(H, W, 3)`` uint8 RGB original of the first image.
        original1: ``(H, W, 3)`` uint8 RGB original of the second image.

    Returns:
        ``(N,)`` pixels, inf where the original track was lost.
    """
    ends_xy, found = track_points(original0, original1, keypoints0_xy)
    return np.where(found, np.linalg.norm(ends_xy - keypoints1_xy, axis=1), np.inf)
