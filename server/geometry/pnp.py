"""Pose of a camera from landmarks: weighted refinement with a covariance, and a search without a prior."""

from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, make_transform, project_to_so3, transform_points
from semcast.server.geometry.edges import whiteners
from semcast.server.geometry.projection import MIN_DEPTH_MAP, project_in_front, project_with_jacobian
from semcast.server.geometry.ray_observations import RayObservations
from semcast.server.geometry.weighting import HUBER_K

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseEstimate:
    """A camera pose.

    Attributes:
        T_cam_world: ``(4, 4)``.
        inliers: ``(N,)`` bool, in front of the camera and within the gate.
        residual_px: ``(N,)`` reprojection errors, as if they were known alike in all directions; infinite
            behind the camera.
        covariance: ``(6, 6)`` of a twist in the camera frame, rotation before translation; None where the
            inliers do not fix the pose.
    """

    T_cam_world: Array
    inliers: NDArray[np.bool_]
    residual_px: Array
    covariance: Array | None

    @property
    def num_inliers(self) -> int:
        """Observations that agree with the pose."""
        return int(self.inliers.sum())


def reprojection_residual(
    camera: Intrinsics, T_cam_world: Array, points_world: Array, keypoints_xy: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Observed minus projected, ``(N, 2)`` pixels, and which points are in front, ``(N,)``; zero where not.

    Args:
        camera: Pinhole.
        T_cam_world: ``(4, 4)``.
        points_world: ``(N, 3)``.
        keypoints_xy: ``(N, 2)`` their observations.
    """
    projected, front = project_in_front(camera, transform_points(T_cam_world, points_world))
    return np.where(front[:, None], keypoints_xy - projected, 0.0), front


def refine_pose(
    camera: Intrinsics,
    T_cam_world: Array,
    points_world: Array,
    keypoints_xy: Array,
    sigma_px: Array,
    gate_px: Array,
    *,
    iterations: int = 10,
    rays: RayObservations | None = None,
    edge: Array | None = None,
    is_rough: bool = True,
) -> PoseEstimate:
    """Minimise weighted reprojection errors under Huber's loss by Gauss-Newton over the pose alone.

    Args:
        camera: Pinhole.
        T_cam_world: Start.
        points_world: ``(N, 3)`` landmarks.
        keypoints_xy: ``(N, 2)`` their observations.
        sigma_px: ``(N,)`` standard deviation of each observation per coordinate.
        gate_px: ``(N,)`` reprojection error up to which an observation is an inlier.
        iterations: Steps at most.
        rays: Observations of points of unknown depth.
        edge: ``(N, 2)`` of the observations, see ``edges``; None where errors have no direction.
        is_rough: The start is: in the first two steps, points three gates off have a say too.

    Returns:
        The refined pose; the start with no inlier where nothing could be solved.
    """
    seen = _whitened_observations(camera, points_world, keypoints_xy, sigma_px, edge)
    far_px = 3.0 * gate_px
    T = T_cam_world.copy()
    hessian = np.zeros((6, 6))
    for iteration in range(iterations):
        # Early steps are more tolerant, so that a poor start does not lose the points that would mend it.
        is_early = is_rough and iteration < 2
        tolerance = 4.0 if is_early else 1.0
        equations = seen.normal_equations(T, tolerance, None if is_early else far_px)
        step = None
        if equations is not None:
            hessian, gradient = equations
            if rays is not None:
                more = rays.normal_equations(camera, T, tolerance, None if is_early else 3.0)
                hessian, gradient = hessian + more[0], gradient + more[1]
            step = _damped_step(hessian, gradient)
        if step is None:
            return _without_inliers(T_cam_world.copy(), len(points_world))
        T = exp_se3(step) @ T
        if iteration >= 3 and float(np.abs(step).max()) < 1e-6:
            break
    T = make_transform(project_to_so3(T[:3, :3]), T[:3, 3])
    length = seen.errors_px(T)
    return PoseEstimate(T, length < gate_px, length, _covariance(hessian))


@dataclass(frozen=True)
class _WhitenedObservations:
    """Observations of landmarks, scaled so that each has the same standard deviation in all directions.

    Coordinates lead, so that numpy sums over contiguous rows.

    Attributes:
        xyz: ``(3, N)`` landmarks, world frame.
        observed: ``(2, N)`` whitened pixels from the principal point.
        axes: ``(2, 2, N)`` or ``(2, 2, 1)``, see ``project_with_jacobian``.
        weight: ``(N,)`` inverse variance of each.
        huber_px: ``(N,)`` error beyond which its loss grows linearly.
    """

    xyz: Array
    observed: Array
    axes: Array
    weight: Array
    huber_px: Array

    def normal_equations(
        self, T_cam_world: Array, tolerance: float, far_px: Array | None
    ) -> tuple[Array, Array] | None:
        """Hessian ``(6, 6)`` and gradient ``(6,)`` of a Gauss-Newton step; None with fewer than 3 points.

        Args:
            T_cam_world: Pose to linearise at.
            tolerance: By what the Huber threshold is multiplied.
            far_px: ``(N,)`` errors from which on an observation is left out; None to leave out none.
        """
        xyz_cam, used = _in_front(T_cam_world, self.xyz)
        if int(used.sum()) < 3:
            return None
        projected, J = project_with_jacobian(xyz_cam, self.axes)
        residual = self.observed - projected
        length = np.sqrt(np.square(residual).sum(axis=0))
        w = self.weight * np.minimum(1.0, tolerance * self.huber_px / np.maximum(length, 1e-9))
        w *= used if far_px is None else used & (length < far_px)
        weighted, rows = (J * w).reshape(6, -1), J.reshape(6, -1)
        return weighted @ rows.T, weighted @ residual.ravel()

    def errors_px(self, T_cam_world: Array) -> Array:
        """Whitened reprojection errors ``(N,)``; infinite behind the camera."""
        xyz_cam, used = _in_front(T_cam_world, self.xyz)
        u, v = xyz_cam[:2] / xyz_cam[2]
        residual = self.observed - self.axes[0] * u - self.axes[1] * v
        return np.where(used, np.sqrt(np.square(residual).sum(axis=0)), np.inf)


def _whitened_observations(
    camera: Intrinsics,
    points_world: Array,
    keypoints_xy: Array,
    sigma_px: Array,
    edge: Array | None,
) -> _WhitenedObservations:
    """Prepare the arguments of ``refine_pose``."""
    whitener = np.eye(2)[None] if edge is None else whiteners(edge)
    axes = np.ascontiguousarray(whitener.transpose(2, 1, 0)) * [[[camera.fx]], [[camera.fy]]]
    x, y = keypoints_xy[:, 0] - camera.cx, keypoints_xy[:, 1] - camera.cy
    observed = whitener[:, :, 0].T * x + whitener[:, :, 1].T * y
    xyz = np.ascontiguousarray(points_world.T)
    return _WhitenedObservations(xyz, observed, axes, sigma_px**-2.0, HUBER_K * sigma_px)


def _in_front(T_cam_world: Array, xyz: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Points ``(3, N)`` in a camera, and which are in front of it; the others are put on its axis."""
    xyz_cam = T_cam_world[:3, :3] @ xyz + T_cam_world[:3, 3:]
    used = xyz_cam[2] > MIN_DEPTH_MAP
    if not used.all():
        xyz_cam = np.where(used, xyz_cam, np.array([[0.0], [0.0], [1.0]]))
    return xyz_cam, used


def _damped_step(hessian: Array, gradient: Array) -> Array | None:
    """Twist ``(6,)`` that solves the normal equations; None where nothing does."""
    try:
        step = np.linalg.solve(hessian + 1e-9 * np.trace(hessian) / 6.0 * np.eye(6), gradient)
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None


def _without_inliers(T_cam_world: Array, count: int) -> PoseEstimate:
    return PoseEstimate(T_cam_world, np.zeros(count, bool), np.full(count, np.inf), None)


def _covariance(hessian: Array) -> Array | None:
    """Inverse of the information (Proposition 1), None where it is not positive definite."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    normalised = hessian / np.outer(scale, scale)
    try:
        if float(np.linalg.eigvalsh(normalised)[0]) < 1e-10:
            return None
        return np.asarray(np.linalg.inv(normalised) / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None


def poselib_camera(camera: Intrinsics) -> dict[str, object]:
    """A pinhole as PoseLib takes it."""
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }


def search_pose(
    camera: Intrinsics,
    points_world: Array,
    keypoints_xy: Array,
    sigma_px: Array,
    gate_px: Array,
    *,
    seed: int,
    min_inliers: int = 12,
    max_iterations: int = 1000,
    edge: Array | None = None,
) -> PoseEstimate | None:
    """Find a pose without a prior by PoseLib's LO-RANSAC over three points, then refine it with weights.

    It draws uniformly: three points are found soon, and a misleading order would cost the pose.

    Args:
        camera: Pinhole.
        points_world: ``(N, 3)`` landmarks, map units.
        keypoints_xy: ``(N, 2)`` their observations in pixels.
        sigma_px: ``(N,)`` standard deviation of each observation per coordinate.
        gate_px: ``(N,)`` reprojection error up to which an observation is an inlier. The search has a single
            threshold, their median within 2 to 8 pixels.
        seed: Of the search.
        min_inliers: Observations that must agree with what the search found, and after the refinement.
        max_iterations: Hypotheses at most.
        edge: See ``refine_pose``.

    Returns:
        The pose, or None when fewer than ``min_inliers`` agree.
    """
    if len(points_world) < max(4, min_inliers):
        return None
    threshold_px = float(np.clip(np.median(gate_px), 2.0, 8.0))
    options = {
        "max_reproj_error": threshold_px,
        "max_iterations": max_iterations,
        "min_iterations": 50,
        "seed": seed,
    }
    found, info = poselib.estimate_absolute_pose(
        keypoints_xy, points_world, poselib_camera(camera), options, {}
    )
    R, t = np.asarray(found.R, dtype=np.float64), np.asarray(found.t, dtype=np.float64)
    if info["num_inliers"] < min_inliers or not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    start = make_transform(project_to_so3(R), t)
    # Most observations may be wrong: all together they would pull the pose away from where it was found.
    observed = (points_world, keypoints_xy, sigma_px, gate_px)
    estimate = refine_pose(camera, start, *observed, edge=edge, is_rough=False)
    return estimate if estimate.num_inliers >= min_inliers else None
