"""A rolling shutter's readout time, from what a bundle adjustment leaves over.

An adjustment gives all rows of an image one pose. Where rows are read one after the other, a row that is read
``t`` seconds after the middle one is seen from a pose further on, and its points are off by ``t`` times their
flow. Poses and points take some of that over; the rest stays in the residuals, and is proportional to the
readout time. That is one unknown in a linear least squares problem: the residuals are compared with the same
pattern, after poses and points had a chance to explain either.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import MAX_READOUT_MS, Intrinsics, ReadoutFrom
from semcast.common.geometry import invert_transform, log_so3
from semcast.server.geometry.pnp import MIN_DEPTH_MAP
from semcast.server.mapping.bundle_problem import BundleProblem, ViewMotion

Array = NDArray[np.float64]
#: Rows are read from top or bottom, columns (of an upright phone) from left or right.
Axis = Literal["rows", "columns"]

SIDES: dict[Axis, tuple[ReadoutFrom, ReadoutFrom]] = {
    "rows": ("top", "bottom"),
    "columns": ("left", "right"),
}
AXES: tuple[Axis, Axis] = ("rows", "columns")
#: Residuals beyond so many medians count less (Huber).
_HUBER_MEDIANS = 1.5
#: Holds what nothing else does, as share of the mean of the diagonal: the gauge.
_DAMPING = 1e-6
#: Groups of keyframes, one left out at a time, that say how sure an estimate is.
NUM_GROUPS = 10


@dataclass(frozen=True, order=True)
class Readout:
    """A readout time with its direction.

    Attributes:
        axis: What is read one after the other.
        signed_ms: From the first to the last; below 0 from the last to the first.
    """

    axis: Axis
    signed_ms: float

    @property
    def ms(self) -> float:
        """Time from the first row or column that is read to the last."""
        return abs(self.signed_ms)

    @property
    def side(self) -> ReadoutFrom:
        """Where it begins."""
        return SIDES[self.axis][self.signed_ms < 0]

    @staticmethod
    def of(camera: Intrinsics) -> "Readout":
        """Return that of a camera."""
        axis: Axis = "rows" if camera.readout_from in SIDES["rows"] else "columns"
        return Readout(axis, camera.readout_ms * (-1 if camera.readout_from == SIDES[axis][1] else 1))

    def put_on(self, camera: Intrinsics) -> Intrinsics:
        """Return a camera with this readout."""
        return replace(camera, readout_ms=min(self.ms, MAX_READOUT_MS), readout_from=self.side)

    def with_more(self, more: "Readout") -> "Readout":
        """Return the readout that is longer by another one, whose axis counts."""
        return Readout(more.axis, self.signed_ms * (self.axis == more.axis) + more.signed_ms)

    def __str__(self) -> str:
        return f"{self.ms:.1f} ms from {self.side}"


@dataclass(frozen=True)
class ReadoutFit:
    """The readout time that residuals speak for.

    Attributes:
        readout: Along the axis that explains more.
        sigma_ms: Standard deviation, by leaving out a part of the keyframes at a time.
        explained: Share of the squared residuals that it explains.
    """

    readout: Readout
    sigma_ms: float
    explained: float


def body_velocity(T_world_before: Array, T_world_cam: Array, T_world_after: Array, step_s: float) -> Array:
    """Return the velocity of a camera between two poses, see ``ViewMotion``: ``(6,)``.

    Args:
        T_world_before: ``(4, 4)`` a moment before.
        T_world_cam: ``(4, 4)`` in whose frame the velocity is given.
        T_world_after: ``(4, 4)`` a moment after.
        step_s: From before to after.
    """
    turned_rad = log_so3(T_world_before[:3, :3].T @ T_world_after[:3, :3])
    moved_map = T_world_cam[:3, :3].T @ (T_world_after[:3, 3] - T_world_before[:3, 3])
    return np.concatenate([turned_rad, moved_map]) / step_s


def information(
    problem: BundleProblem, motion: ViewMotion, T_world_cam: Array, xyz: Array, residual_px: Array
) -> Array:
    """Return what each view's residuals say about the readout time along rows and columns.

    Sums of the products of three patterns: the residuals, and the effect that a second of readout along rows
    or along columns has. Each is without what a change of poses and points explains of it.

    Args:
        problem: That was adjusted; dense algebra, for a window's number of views.
        motion: Of its views.
        T_world_cam: ``(K, 4, 4)`` after the adjustment.
        xyz: ``(P, 3)`` after the adjustment.
        residual_px: ``(M, 2)``, NaN where not used.

    Returns:
        ``(K, 3, 3)``, zero for views of unknown velocity.
    """
    num_views, num_points = len(T_world_cam), len(xyz)
    T_cam_world = invert_transform(T_world_cam)[problem.view]
    points = np.einsum("mij,mj->mi", T_cam_world[:, :3, :3], xyz[problem.point]) + T_cam_world[:, :3, 3]
    used = np.isfinite(residual_px).all(axis=1) & (points[:, 2] > MIN_DEPTH_MAP)
    used &= np.isfinite(motion.velocity[problem.view]).all(axis=1)
    none = np.zeros((num_views, 3, 3))
    if not used.any():
        return none
    view, point, points = problem.view[used], problem.point[used], points[used]
    by_point = _by_point(problem.intrinsics, points)
    by_pose = _by_pose(by_point, points)
    by_xyz = by_point @ T_cam_world[used, :3, :3]
    flow = np.einsum("mij,mj->mi", by_pose, motion.velocity[view])
    share = _shares(motion.size_wh, problem.xy[used])
    patterns = np.stack([residual_px[used], share[:, 1:] * flow, share[:, :1] * flow], axis=2)
    weight = _weights(residual_px[used], problem.sigma_px[used])[:, None, None]
    left = _unexplained(
        weight * by_pose, weight * by_xyz, weight * patterns, view, point, (num_views, num_points)
    )
    np.add.at(none, view, np.einsum("mkg,mkh->mgh", left, left))
    return none


def _shares(size_wh: tuple[int, int], xy: Array) -> Array:
    """Return which share of the readout after the middle each pixel is read, ``(M, 2)`` by column and row."""
    last = np.maximum(np.array(size_wh, dtype=np.float64) - 1.0, 1.0)
    return np.asarray(xy / last - 0.5)


def lean(camera: Intrinsics, points_cam: Array, flow_px_s: Array) -> Array:
    """Return by how much the pose of a rolling shutter's image is off its middle row's, ``(6,)`` a twist.

    That is what a pose takes over of what the readout does to points, by least squares.

    Args:
        camera: Pinhole, with the readout.
        points_cam: ``(M, 3)`` seen, in its frame.
        flow_px_s: ``(M, 2)`` how they move in the image, pixels per second.
    """
    readout = Readout.of(camera)
    by_pose = _by_pose(_by_point((camera.fx, camera.fy, camera.cx, camera.cy), points_cam), points_cam)
    share = _shares((camera.width, camera.height), camera.project(points_cam))
    moved_px = 1e-3 * readout.signed_ms * share[:, [AXES.index(readout.axis) ^ 1]] * flow_px_s
    return np.asarray(np.linalg.lstsq(by_pose.reshape(-1, 6), moved_px.ravel(), rcond=None)[0])


def _by_pose(by_point: Array, points_cam: Array) -> Array:
    """Return the change of pixels with the camera's pose in its own frame, ``(M, 2, 6)``."""
    return np.concatenate([by_point @ _skews(points_cam), -by_point], axis=2)


def _by_point(intrinsics: tuple[float, float, float, float], points_cam: Array) -> Array:
    """Return the change of pixels with points in the camera's frame, ``(M, 2, 3)``."""
    fx, fy, _, _ = intrinsics
    x, y, z = points_cam.T
    jacobian = np.zeros((len(points_cam), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = fx / z, -fx * x / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = fy / z, -fy * y / z**2
    return jacobian


def _skews(points: Array) -> Array:
    """Return the cross product matrices of vectors ``(M, 3)``."""
    x, y, z = points.T
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)


def _weights(residual_px: Array, sigma_px: Array) -> Array:
    """Return the square root of each observation's weight, ``(M,)``."""
    error = np.linalg.norm(residual_px, axis=1) / sigma_px
    usual = _HUBER_MEDIANS * np.median(error) + 1e-9
    return np.asarray(np.sqrt(usual / np.maximum(error, usual)) / sigma_px)


def _unexplained(
    by_pose: Array,
    by_xyz: Array,
    patterns: Array,
    view: NDArray[np.intp],
    point: NDArray[np.intp],
    counts: tuple[int, int],
) -> Array:
    """Return patterns ``(M, 2, G)`` without what poses and points explain of them, by least squares.

    Points are eliminated first (Schur complement).
    """
    num_views, num_points = counts
    poses = np.zeros((num_views, 6, 6))
    np.add.at(poses, view, by_pose.transpose(0, 2, 1) @ by_pose)
    own = np.zeros((num_points, 3, 3))
    np.add.at(own, point, by_xyz.transpose(0, 2, 1) @ by_xyz)
    own += (_DAMPING * np.trace(own, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    both = np.zeros((num_points, 3, num_views, 6))
    both[point, :, view] = by_xyz.transpose(0, 2, 1) @ by_pose  # a view sees a point once
    each = both.reshape(num_points, 3, 6 * num_views)
    of_points = np.zeros((num_points, 3, patterns.shape[2]))
    np.add.at(of_points, point, by_xyz.transpose(0, 2, 1) @ patterns)
    of_poses = np.zeros((num_views, 6, patterns.shape[2]))
    np.add.at(of_poses, view, by_pose.transpose(0, 2, 1) @ patterns)
    inverse = np.linalg.inv(own)
    solved = (inverse @ each).reshape(3 * num_points, -1)
    flat = each.reshape(3 * num_points, -1)
    system = -flat.T @ solved
    for k in range(num_views):
        system[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += poses[k]
    system += (_DAMPING * np.trace(poses, axis1=1, axis2=2).mean() / 6 + 1e-12) * np.eye(len(system))
    right = of_poses.reshape(6 * num_views, -1) - solved.T @ of_points.reshape(3 * num_points, -1)
    moved = np.linalg.solve(system, right)
    shifted = inverse @ (of_points - each @ moved)
    left = patterns - by_xyz @ shifted[point]
    return np.asarray(left - by_pose @ moved.reshape(num_views, 6, -1)[view])


def fit_readout(views: Sequence[Array] | Array, axis: Axis | None = None) -> ReadoutFit | None:
    """Return the readout time that views speak for, None where they say nothing.

    Args:
        views: ``(3, 3)`` of each, as ``information`` gives them.
        axis: What is read one after the other, None for what explains more.
    """
    each = np.asarray(views, dtype=np.float64).reshape(-1, 3, 3)
    each = each[each[:, 0, 0] > 0.0]
    total = each.sum(axis=0)
    told = (np.diag(total)[1:] > 0.0) & np.array([axis in (None, name) for name in AXES])
    if len(each) < 3 or not told.any():
        return None
    gain = np.where(told, total[0, 1:] ** 2 / np.where(told, np.diag(total)[1:], 1.0), 0.0)
    best = int(gain.argmax())
    num_groups = min(NUM_GROUPS, len(each))
    group = np.arange(len(each)) * num_groups // len(each)
    without = total - np.stack([each[group == k].sum(axis=0) for k in range(num_groups)])
    slopes = without[:, 0, 1 + best] / np.maximum(without[:, 1 + best, 1 + best], 1e-12)
    spread = np.sqrt((num_groups - 1) / num_groups * ((slopes - slopes.mean()) ** 2).sum())
    readout_s = total[0, 1 + best] / total[1 + best, 1 + best]
    return ReadoutFit(
        Readout(AXES[best], float(1e3 * readout_s)), float(1e3 * spread), float(gain[best] / total[0, 0])
    )
