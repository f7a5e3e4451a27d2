"""Observations of points whose depth nobody knows: what they tell of a pose.

A point that another camera saw lies on a ray. In this image that ray is a part of an epipolar line: it begins
where the point would be if it were infinitely far away, and ends where it would be at the nearest depth that is
thought possible. How far an observation is off that part tells of the pose, and where along it does not. Each
point takes the depth that explains its observation best, anew at each pose (variable projection: Golub and
Pereyra 1973), so the derivatives are those of a point at that depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.projection import project_with_jacobian
from semcast.server.geometry.weighting import HUBER_K

Array = NDArray[np.float64]

#: Part of the depth in the other camera that a point must have in this one.
_MIN_DEPTH_RATIO = 0.05


@dataclass(frozen=True)
class RayObservations:
    """Observations of points on rays; coordinates lead, so that numpy sums over contiguous rows.

    Attributes:
        origin: ``(3, N)`` centres of the cameras that saw the points, world frame.
        direction: ``(3, N)`` the rays, at a depth of 1 in those cameras, world frame.
        nearest: ``(N,)`` largest inverse depth in those cameras.
        observed: ``(2, N)`` pixels from the principal point.
        covariance: ``(3, N)`` xx, xy and yy of the observations, with that of the other camera's, pixels^2.
        gate: ``(N,)`` distance in standard deviations up to which an observation agrees.
    """

    origin: Array
    direction: Array
    nearest: Array
    observed: Array
    covariance: Array
    gate: Array

    def __len__(self) -> int:
        return self.observed.shape[1]

    def __getitem__(self, rows: NDArray[np.bool_]) -> "RayObservations":
        parts = (self.origin, self.direction, self.nearest, self.observed, self.covariance, self.gate)
        return RayObservations(*(part[..., rows] for part in parts))

    @classmethod
    def joined(cls, parts: Sequence["RayObservations"]) -> "RayObservations":
        """All observations of several."""
        names = (field.name for field in fields(cls))
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts], axis=-1) for name in names})

    def sizes(self, camera: Intrinsics, T_cam_world: Array) -> Array:
        """Distances ``(N,)`` from the rays in standard deviations; infinite behind the camera."""
        at = _Linearised.of(self, camera, T_cam_world)
        return np.where(at.used, np.hypot(at.residual[0], at.residual[1]), np.inf)

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
        at = _Linearised.of(self, camera, T_cam_world)
        size = np.hypot(at.residual[0], at.residual[1])
        w = at.used * np.minimum(1.0, tolerance * HUBER_K / np.maximum(size, 1e-9))
        if far is not None:
            w = w * (size < far * self.gate)
        weighted, rows = (at.J * w).reshape(6, -1), at.J.reshape(6, -1)
        return weighted @ rows.T, weighted @ at.residual.ravel()


@dataclass(frozen=True)
class _Linearised:
    """Residuals at a pose and their derivatives.

    Attributes:
        residual: ``(2, N)`` across the line, and along it beyond the ray's ends, in standard deviations.
        J: ``(6, 2, N)`` derivatives of the projection by a twist, rotation before translation.
        used: ``(N,)`` bool, which are in front of the camera.
    """

    residual: Array
    J: Array
    used: NDArray[np.bool_]

    @classmethod
    def of(cls, rays: RayObservations, camera: Intrinsics, T_cam_world: Array) -> "_Linearised":
        R, t = T_cam_world[:3, :3], T_cam_world[:3, 3:]
        turned, centre = R @ rays.direction, R @ rays.origin + t
        used = turned[2] > _MIN_DEPTH_RATIO
        z = np.where(used, turned[2], 1.0)
        far_away = turned / z
        centre = centre / z
        focal = np.array([[camera.fx], [camera.fy]])
        # How the projection moves as the point comes nearer, and so where along its way the observation is.
        way = focal * (centre[:2] - far_away[:2] * centre[2])
        length = np.sqrt((way * way).sum(axis=0))
        way = way / np.maximum(length, 1e-12)
        offset = rays.observed - focal * far_away[:2]
        along = (offset * way).sum(axis=0)
        across = offset[1] * way[0] - offset[0] * way[1]
        depth_there = 1.0 + rays.nearest * centre[2]
        passes = depth_there < _MIN_DEPTH_RATIO
        end = np.where(passes, np.inf, rays.nearest * length / np.where(passes, 1.0, depth_there))
        on_ray = np.clip(along, 0.0, end)
        inverse_depth = np.clip(on_ray / np.maximum(length - on_ray * centre[2], 1e-12), 0.0, rays.nearest)
        xx, xy, yy = rays.covariance
        scale = np.stack(
            [
                xx * way[1] ** 2 - 2.0 * xy * way[0] * way[1] + yy * way[0] ** 2,
                xx * way[0] ** 2 + 2.0 * xy * way[0] * way[1] + yy * way[1] ** 2,
            ]
        )
        scale = 1.0 / np.sqrt(np.maximum(scale, 1e-12))
        beyond = along - on_ray
        residual = np.stack([across, beyond]) * scale * used
        # ``axes[j][i]`` is what a pixel of coordinate j counts for residual i.
        axes = np.stack(
            [
                np.stack([-way[1], way[0] * (beyond != 0.0)]) * scale * camera.fx,
                np.stack([way[0], way[1] * (beyond != 0.0)]) * scale * camera.fy,
            ]
        )
        _, J = project_with_jacobian(far_away + inverse_depth * centre, axes)
        J[3:] *= inverse_depth / z
        return cls(residual, J, used)
