"""Points of the world in a camera: how deep they are, where they are seen, and how that changes with them."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics

Array = NDArray[np.float64]

#: Landmarks nearer than this to the camera plane (map units) have no usable projection.
MIN_DEPTH_MAP = 1e-3


def depths_in(T_cam_world: Array, xyz: Array) -> Array:
    """Depth of points in a camera, ``(N,)`` map units, negative behind it.

    Args:
        T_cam_world: ``(4, 4)`` of one camera, or ``(N, 4, 4)`` of each point's own.
        xyz: ``(N, 3)`` world frame.
    """
    row = T_cam_world[..., 2, :]
    if row.ndim == 1:
        return np.asarray(xyz @ row[:3] + row[3])
    return np.asarray(np.einsum("ni,ni->n", row[:, :3], xyz) + row[:, 3])


def project_in_front(camera: Intrinsics, points_cam: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Project points of which some may be behind the camera.

    Args:
        camera: Pinhole.
        points_cam: ``(N, 3)`` camera frame.

    Returns:
        ``(N, 2)`` pixels, finite but of no meaning for points that are not in front, and ``(N,)`` bool, which
        are: deeper than ``MIN_DEPTH_MAP``.
    """
    front = points_cam[:, 2] > MIN_DEPTH_MAP
    z = np.where(front, points_cam[:, 2], 1.0)
    x_px, y_px = camera.fx * points_cam[:, 0] / z, camera.fy * points_cam[:, 1] / z
    return np.stack([x_px + camera.cx, y_px + camera.cy], axis=1), front


def projection_jacobian(camera: Intrinsics, points_cam: Array) -> Array:
    """Return the derivatives of pixels by points in the camera's frame, ``(N, 2, 3)``.

    Args:
        camera: Pinhole.
        points_cam: ``(N, 3)`` camera frame, in front of it.
    """
    x, y, z = points_cam.T
    jacobian = np.zeros((len(points_cam), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    return jacobian
