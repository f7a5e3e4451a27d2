"""Points from rays: linear multi-view triangulation with refinement, and its checks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import angles_between_deg
from semcast.server.geometry.edges import whiteners
from semcast.server.geometry.projection import MIN_DEPTH_MAP, project_in_front, projection_jacobian

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Triangulation:
    """Points and what speaks for them.

    Attributes:
        xyz: ``(P, 3)`` world frame.
        parallax_deg: ``(P,)`` largest angle of a point's rays to its first ray.
        error_sigma: ``(P,)`` root mean square reprojection error in standard deviations.
        in_front: ``(P,)`` bool, positive depth in every view.
    """

    xyz: Array
    parallax_deg: Array
    error_sigma: Array
    in_front: NDArray[np.bool_]


def _sum_by(index: NDArray[np.intp], values: Array, count: int) -> Array:
    """Sum rows of ``values`` that share an index."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    columns = [np.bincount(index, weights=flat[:, k], minlength=count) for k in range(flat.shape[1])]
    return np.stack(columns, axis=1).astype(np.float64).reshape(count, *values.shape[1:])


def triangulate(
    camera: Intrinsics,
    T_cam_world: Array,
    view: NDArray[np.intp],
    point: NDArray[np.intp],
    keypoints_xy: Array,
    sigma_px: Array,
    num_points: int,
    *,
    refinements: int = 3,
    edge: Array | None = None,
) -> Triangulation:
    """Triangulate many points, each from any number of views, all at once.

    The start is the point nearest to all rays; Gauss-Newton steps on the weighted reprojection error follow.

    Args:
        camera: Pinhole.
        T_cam_world: ``(V, 4, 4)`` poses of the views.
        view: ``(M,)`` view of each observation.
        point: ``(M,)`` point of each observation, in [0, num_points).
        keypoints_xy: ``(M, 2)``.
        sigma_px: ``(M,)`` standard deviations.
        num_points: Number of points; one without two views gets a useless position and parallax 0.
        refinements: Gauss-Newton steps.
        edge: ``(M, 2)`` of the observations, see ``edges``; None where errors have no direction.
    """
    R, t = T_cam_world[view, :3, :3], T_cam_world[view, :3, 3]
    w = sigma_px**-2.0
    centre = -np.einsum("mji,mj->mi", R, t)
    xyz = _nearest_to_rays(camera.unproject(keypoints_xy), R, centre, w, point, num_points)
    whitener = None if edge is None else whiteners(edge)
    for _ in range(refinements):
        step = _refinement_step(camera, R, t, xyz, keypoints_xy, w, point, whitener)
        # A step longer than half the distance to the cameras has left the linear range.
        reach = 0.5 * np.linalg.norm(xyz - mean_centre(centre, point, num_points), axis=1)
        length = np.linalg.norm(step, axis=1)
        xyz = xyz + step * np.minimum(1.0, reach / np.maximum(length, 1e-12))[:, None]
    points_cam = (R @ xyz[point][:, :, None])[..., 0] + t
    projected, front = project_in_front(camera, points_cam)
    error_px = keypoints_xy - projected
    if whitener is not None:
        error_px = (whitener @ error_px[..., None])[..., 0]
    square = (error_px**2).sum(axis=1) * w
    count = np.bincount(point, minlength=num_points)
    error = np.sqrt(np.bincount(point, weights=square, minlength=num_points) / np.maximum(1, 2 * count))
    behind = np.bincount(point, weights=~front, minlength=num_points) > 0
    share = None if whitener is None else _share_across(camera, R, points_cam, xyz, centre, point, whitener)
    good_point = np.isfinite(xyz).all(axis=1) & (count >= 2)
    return Triangulation(
        xyz=np.nan_to_num(xyz),
        parallax_deg=np.where(
            good_point, parallax_deg(centre, np.nan_to_num(xyz), point, num_points, share), 0.0
        ),
        error_sigma=np.where(good_point, error, np.inf),
        in_front=~behind & good_point,
    )


def _nearest_to_rays(
    rays_cam: Array, R_cam_world: Array, centre: Array, w: Array, point: NDArray[np.intp], num_points: int
) -> Array:
    """Points ``(P, 3)`` with the least sum of weighted squared distances to the rays that see them."""
    ray = np.einsum("mji,mj->mi", R_cam_world, rays_cam)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    A = _sum_by(point, across * w[:, None, None], num_points)
    b = _sum_by(point, np.einsum("mij,mj->mi", across, centre) * w[:, None], num_points)
    return _solve(A, b)


def _refinement_step(
    camera: Intrinsics,
    R_cam_world: Array,
    t_cam_world: Array,
    xyz: Array,
    keypoints_xy: Array,
    w: Array,
    point: NDArray[np.intp],
    whitener: Array | None,
) -> Array:
    """Gauss-Newton step ``(P, 3)`` of all points on the weighted reprojection error."""
    points_cam = (R_cam_world @ xyz[point][:, :, None])[..., 0] + t_cam_world
    z = np.maximum(points_cam[:, 2], MIN_DEPTH_MAP)
    u, v = points_cam[:, 0] / z, points_cam[:, 1] / z
    residual = keypoints_xy - np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=1)
    J = _jacobian(camera, R_cam_world, points_cam)
    if whitener is not None:
        J, residual = whitener @ J, np.einsum("mij,mj->mi", whitener, residual)
    good = (points_cam[:, 2] > MIN_DEPTH_MAP) & np.isfinite(residual).all(axis=1)
    step_w = np.where(good, w, 0.0)
    H = _sum_by(point, np.swapaxes(J, 1, 2) @ (J * step_w[:, None, None]), len(xyz))
    weighted = np.nan_to_num(residual) * step_w[:, None]
    g = _sum_by(point, (np.swapaxes(J, 1, 2) @ weighted[..., None])[..., 0], len(xyz))
    return _solve(H, g)


def _jacobian(camera: Intrinsics, R_cam_world: Array, points_cam: Array) -> Array:
    """Change of pixels with points in the world, ``(M, 2, 3)``."""
    in_front = np.column_stack([points_cam[:, :2], np.maximum(points_cam[:, 2], MIN_DEPTH_MAP)])
    return projection_jacobian(camera, in_front) @ R_cam_world


def mean_centre(centre: Array, point: NDArray[np.intp], num_points: int) -> Array:
    """Mean camera centre of each point's views, ``(P, 3)``; zero for a point without one.

    Args:
        centre: ``(M, 3)`` world position of the camera of each observation.
        point: ``(M,)`` its point, in [0, num_points).
        num_points: Number of points.
    """
    count = np.maximum(1, np.bincount(point, minlength=num_points))
    return _sum_by(point, centre, num_points) / count[:, None]


def _share_across(
    camera: Intrinsics,
    R_cam_world: Array,
    points_cam: Array,
    xyz: Array,
    centre: Array,
    point: NDArray[np.intp],
    whitener: Array,
) -> Array:
    """Share of the angle to a point's first ray that counts, ``(M,)``: along an edge it tells little."""
    first_ray = xyz - centre[_first(point, len(xyz))]
    moved = _jacobian(camera, R_cam_world, points_cam) @ first_ray[point][..., None]
    size, told = (np.linalg.norm(way[..., 0], axis=1) for way in (moved, whitener @ moved))
    return np.asarray(np.minimum(1.0, told / np.maximum(size, 1e-12)))


def _first(point: NDArray[np.intp], num_points: int) -> NDArray[np.intp]:
    """Row of the first observation of each point, ``(P,)``; -1 without one."""
    first = np.full(num_points, -1)
    first[point[::-1]] = np.arange(len(point))[::-1]
    return first


def parallax_deg(
    centre: Array, xyz: Array, point: NDArray[np.intp], num_points: int, share: Array | None = None
) -> Array:
    """Largest angle at each point between its first ray and any other, ``(P,)`` degrees; 0 without one.

    Args:
        centre: ``(M, 3)`` world position of the camera of each observation.
        xyz: ``(P, 3)`` the points in the world frame.
        point: ``(M,)`` point of each observation, in [0, num_points).
        num_points: Number of points.
        share: ``(M,)`` of each ray's angle that counts; None for all of it.
    """
    to_camera = centre - xyz[point]
    to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-12)
    reference = to_camera[_first(point, num_points)[point]]
    angle = angles_between_deg(reference, to_camera) * (1.0 if share is None else share)
    largest = np.zeros(num_points)
    np.maximum.at(largest, point, angle)
    return largest


def _solve(A: Array, b: Array) -> Array:
    """Solve ``(P, 3, 3)`` systems; singular ones give a damped answer."""
    trace = np.trace(A, axis1=1, axis2=2)
    damped = A + (1e-9 * trace + 1e-30)[:, None, None] * np.eye(3)
    determinant = np.linalg.det(damped)
    usable = np.isfinite(determinant) & (np.abs(determinant) > 1e-200) & np.isfinite(b).all(axis=1)
    damped = np.where(usable[:, None, None], damped, np.eye(3))
    solved = np.linalg.solve(damped, np.where(usable[:, None], b, 0.0)[..., None])[..., 0]
    return np.asarray(np.where(usable[:, None], solved, 0.0))
