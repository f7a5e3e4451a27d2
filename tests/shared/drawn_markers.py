"""Markers laid into images, as a printed one would be seen."""

import cv2
import numpy as np

from semcast.server.export.markers import dictionaries

FAMILY = "apriltag_36h11"


def draw_marker(image, camera, T_cam_marker, side, number):
    """Lay a marker into an image; what is around it stays.

    Args:
        image: ``(H, W, 3)`` uint8.
        camera: Of the image.
        T_cam_marker: From the marker, x right and y up on paper.
        side: Of the black square.
        number: Of the marker.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(dictionaries()[FAMILY])
    printed = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(dictionary, number, 320), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=235
    )
    corners = 0.5 * side * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    xy = camera.project(corners @ T_cam_marker[:3, :3].T + T_cam_marker[:3, 3])
    low, high = 39.5, 359.5
    on_paper = np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)
    H = cv2.getPerspectiveTransform(on_paper, xy.astype(np.float32))
    size_wh = (camera.width, camera.height)
    fine = cv2.GaussianBlur(printed, (0, 0), 1.5)
    warped = cv2.warpPerspective(fine, H, size_wh)
    cover = cv2.warpPerspective(np.full_like(printed, 255), H, size_wh)[..., None] / 255.0
    return (image * (1 - cover) + warped[..., None] * cover).astype(np.uint8)
