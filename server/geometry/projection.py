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


def project_with_jacobian(xyz_cam: Array, axes: Array) -> tuple[Array, Array]:
    """Project points and differentiate by a twist that moves them, ``p' = exp(xi) p``.

    One coordinate of all points lies together, as for the derivatives: there are few, and many points.

    Args:
        xyz_cam: ``(3, N)`` with positive depth.
        axes: ``(2, 2, N)`` by how many pixels, or whitened ones, ``x / z`` and ``y / z`` move a projection,
            or ``(2, 2, 1)`` for all points.

    Returns:
        ``(2, N)`` pixels from the principal point and ``(6, 2, N)`` derivatives, rotation before translation.
    """
    inverse_z = 1.0 / xyz_cam[2]
    u, v = xyz_cam[:2] * inverse_z
    projected = axes[0] * u + axes[1] * v
    J = np.empty((6, *projected.shape))
    J[0] = -axes[1] - projected * v
    J[1] = axes[0] + projected * u
    J[2] = axes[1] * u - axes[0] * v
    J[3:5] = axes * inverse_z
    J[5] = projected * -inverse_z
    return projected, J
