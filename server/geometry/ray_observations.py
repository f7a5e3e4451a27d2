"""Observations of points of which only the ray is known: what they tell of a pose.

A ray from another camera is a piece of an epipolar line in this image. It begins where the point would be if
it were infinitely far away, and ends where it would be at the nearest depth that is thought possible. How far
an observation is off that piece tells of the pose; where along it, tells nothing. Each point takes the depth
that explains its observation best, anew at each pose, and derivatives are those of a point at that depth
(variable projection: Golub and Pereyra 1973). A line that is fixed at one pose, as of a point whose depth is
uncertain, would hold the pose to it: it turns as the camera moves, most for points near the keyframe.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.projection import project_with_jacobian
from semcast.server.geometry.weighting import HUBER_K

Array = NDArray[np.float64]

#: A ray must go ahead in this camera by at least this part of what it does in the other one.
_MIN_DEPTH_RATIO = 0.05
#: Pixels per inverse depth below which a point stays where it is in the image, however near it is.
_NO_WAY_PX = 1e-9


@dataclass(frozen=True)
class RayObservations:
    """Observations of points on rays. Coordinates lead, so that numpy sums over contiguous rows.

    Attributes:
        origin: ``(3, N)`` centres of the cameras that saw the points, world frame.
        direction: ``(3, N)`` the rays, at a depth of 1 in those cameras, world frame.
        min_depth: ``(N,)`` least depth of the points in those cameras and in this one, map units.
        observed: ``(2, N)`` pixels from the principal point.
        covariance: ``(3, N)`` xx, xy and yy of the observations, with that of the other camera's, pixels^2.
        gate: ``(N,)`` distance in standard deviations up to which an observation agrees.
    """

    origin: Array
    direction: Array
    min_depth: Array
    observed: Array
    covariance: Array
    gate: Array

    def __len__(self) -> int:
        return len(self.gate)

    def sizes(self, camera: Intrinsics, T_cam_world: Array) -> Array:
        """Distances ``(N,)`` from the rays in standard deviations; infinite behind the camera."""
        at = _AtPose.of(self, camera, T_cam_world)
        return np.where(at.used, at.size(), np.inf)

    def normal_equations(
        self, camera: Intrinsics, T_cam_world: Array, tolerance: float, far: float | None
    ) -> tuple[Array, Array]:
        """Hessian ``(6, 6)`` and gradient ``(6,)`` of a Gauss-Newton step under Huber's loss.

        Args:
            camera: Pinhole.
            T_cam_world: Pose to linearise at.
            tolerance: By what the Huber threshold is multiplied.
            far: Gates from which on an observation is left out; None to leave out none.
        """
        at = _AtPose.of(self, camera, T_cam_world)
        size, J = at.size(), at.jacobian()
        w = at.used * np.minimum(1.0, tolerance * HUBER_K / np.maximum(size, 1e-9))
        if far is not None:
            w *= size < far * self.gate
        weighted, rows = (J * w).reshape(6, -1), J.reshape(6, -1)
        return weighted @ rows.T, weighted @ at.residual.ravel()


@dataclass(frozen=True)
class _AtPose:
    """Rays as a camera sees them.

    Attributes:
        residual: ``(2, N)`` across the line, and along it beyond the ends of the ray, in standard deviations.
        used: ``(N,)`` bool, which are in front of the camera.
        axes: ``(2, 2, N)`` by how much a projection at unit depth (first index) moves each residual. Along
            the line it is zero on the ray, where the depth follows.
        xyz: ``(3, N)`` the points, camera frame, times their inverse depth and divided by ``z``.
        inverse_depth: ``(N,)`` in the other camera.
        z: ``(N,)`` depth of the ray's direction in this camera.
    """

    residual: Array
    used: NDArray[np.bool_]
    axes: Array
    xyz: Array
    inverse_depth: Array
    z: Array

    @classmethod
    def of(cls, rays: RayObservations, camera: Intrinsics, T_cam_world: Array) -> "_AtPose":
        """Give each point the depth that explains its observation best."""
        R, t = T_cam_world[:3, :3], T_cam_world[:3, 3:]
        infinity, origin = R @ rays.direction, R @ rays.origin + t
        used = infinity[2] > _MIN_DEPTH_RATIO
        z = np.where(used, infinity[2], 1.0)
        infinity /= z
        origin /= z
        infinity[2] = 1.0  # for those that are not used as well: their derivatives are to be finite
        focal_px = np.array([[camera.fx], [camera.fy]])
        # How the projection moves as the point comes nearer, and how far on that way the observation is.
        way = focal_px * (origin[:2] - infinity[:2] * origin[2])
        length = np.hypot(way[0], way[1])
        # A camera that has only turned, or went straight ahead on the ray, sees no line but a point: any
        # direction will do.
        way = np.where(length > _NO_WAY_PX, way / np.maximum(length, _NO_WAY_PX), [[1.0], [0.0]])
        # Where errors have a shape, the best depth is a little beside the foot of the perpendicular. The
        # distance from the line is the same there, and poses become no better for it.
        x, y = rays.observed - focal_px * infinity[:2]
        along, across = x * way[0] + y * way[1], y * way[0] - x * way[1]
        # A camera that went ahead has passed what is nearer to the other one.
        end_depth = np.maximum(rays.min_depth, rays.min_depth / z - origin[2])
        on_ray = np.minimum(np.maximum(along, 0.0), length / (end_depth + origin[2]))
        beyond = along - on_ray
        inverse_depth = on_ray / np.maximum(length - on_ray * origin[2], 1e-12)
        per_sigma = 1.0 / np.sqrt(_variances(rays.covariance, way))
        axes = np.empty((2, 2, len(rays)))
        axes[0, 0], axes[1, 0] = -way[1], way[0]
        axes[:, 1] = way * (beyond != 0.0)
        axes *= per_sigma * focal_px[:, None]
        residual = np.stack([across, beyond]) * (per_sigma * used)
        return cls(residual, used, axes, infinity + inverse_depth * origin, inverse_depth, z)

    def size(self) -> Array:
        """Distances ``(N,)`` in standard deviations."""
        return np.asarray(np.hypot(self.residual[0], self.residual[1]))

    def jacobian(self) -> Array:
        """Derivatives of the projection by a twist, ``(6, 2, N)``, rotation before translation."""
        _, J = project_with_jacobian(self.xyz, self.axes)
        J[3:] *= self.inverse_depth / self.z
        return J


def _variances(covariance: Array, way: Array) -> Array:
    """Variances ``(2, N)`` across unit vectors ``(2, N)`` and along them."""
    xx, xy, yy = covariance
    square, both = way * way, 2.0 * xy * way[0] * way[1]
    along = xx * square[0] + yy * square[1] + both
    return np.stack([xx + yy - along, along])
