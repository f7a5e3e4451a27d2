"""Bundle adjustment of few views by dense algebra: all observations at once, points eliminated (Schur).

For a window that is faster than GTSAM, which has an object for each observation. Loss, damping and when to
stop are those of GTSAM's Levenberg-Marquardt, so that both end in the same place.

Arrays have observations along their last axis, which sums and products then run along.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, invert_transform

Array = NDArray[np.float64]

#: Levenberg-Marquardt damping at the start,
_FIRST_DAMPING = 1e-4
#: the factor it changes by after each step, down for one that was taken and up for one that was not,
_DAMPING_FACTOR = 10.0
#: and where the search for a step ends.
_MAX_DAMPING = 1e5
#: A step is taken if it lowers the cost by this share of what the linear system promised.
_MIN_KEPT_PROMISE = 1e-3
#: The search ends when a step lowers the cost by less than this share,
_SMALL_SHARE = 1e-3
#: or by less than this.
_SMALL = 1e-5
#: A shorter way has no direction.
_LEAST_LENGTH = 1e-12


@dataclass(frozen=True)
class Baseline:
    """A distance between two views that is held.

    Attributes:
        views: Their rows.
        length_map: The distance.
        sigma_map: Its standard deviation.
    """

    views: tuple[int, int]
    length_map: float
    sigma_map: float


@dataclass(frozen=True)
class State:
    """What is adjusted: poses ``T_world_cam (K, 4, 4)`` and points ``xyz (P, 3)``."""

    T_world_cam: Array
    xyz: Array


@dataclass(frozen=True)
class Window:
    """What poses and points are adjusted to.

    Attributes:
        camera: Pinhole.
        free: ``(K,)`` bool, views whose poses are adjusted.
        num_points: Each has an observation.
        view: ``(M,)`` of each observation.
        point: ``(M,)``.
        xy: ``(M, 2)`` pixels.
        whitener: ``(2, 2, M)`` that bring errors in pixels to standard deviations.
        limit: ``(M,)`` Huber's limit in standard deviations.
        baseline: Or None.
    """

    camera: Intrinsics
    free: NDArray[np.bool_]
    num_points: int
    view: NDArray[np.intp]
    point: NDArray[np.intp]
    xy: Array
    whitener: Array
    limit: Array
    baseline: Baseline | None

    @cached_property
    def num_unknowns(self) -> int:
        """Of the poses."""
        return 6 * int(self.free.sum())

    @cached_property
    def first_unknown(self) -> NDArray[np.intp]:
        """``(K,)`` of each view's pose, of no meaning for those that are not free."""
        return np.asarray(6 * (np.cumsum(self.free) - 1))

    @cached_property
    def of_free(self) -> NDArray[np.intp]:
        """Observations of free views, one view after the other."""
        rows = np.flatnonzero(self.free[self.view])
        return rows[np.argsort(self.view[rows], kind="stable")]

    @cached_property
    def place(self) -> NDArray[np.intp]:
        """Where the products of points' and poses' slopes, ``(3, 6, F)``, belong in ``Normal.both``, flat."""
        row = 3 * self.point[self.of_free] + np.arange(3)[:, None]
        column = self.first_unknown[self.view[self.of_free]] + np.arange(6)[:, None]
        return np.asarray((row[:, None] * self.num_unknowns + column).ravel())


@dataclass(frozen=True)
class Seen:
    """A state as its views see it.

    Attributes:
        state: The state.
        R_cam_world: ``(3, 3, M)`` of the view of each observation.
        points_cam: ``(3, M)`` its point in that view.
        residual: ``(2, M)`` observed minus projected in standard deviations; large, and nothing changes it,
            behind the camera.
        length: ``(M,)`` of the residual.
        cost: Sum of all losses.
    """

    state: State
    R_cam_world: Array
    points_cam: Array
    residual: Array
    length: Array
    cost: float


def see(window: Window, state: State) -> Seen:
    """Project all points, and sum up how far off that is."""
    T_cam_world = invert_transform(state.T_world_cam).transpose(1, 2, 0)[:3].take(window.view, axis=2)
    R_cam_world = T_cam_world[:, :3]
    points = np.einsum("ijm,jm->im", R_cam_world, state.xyz.T.take(window.point, axis=1)) + T_cam_world[:, 3]
    z = np.where(points[2] > 0.0, points[2], np.nan)
    camera = window.camera
    seen_xy = np.stack([camera.fx * points[0] / z + camera.cx, camera.fy * points[1] / z + camera.cy])
    error_px = np.nan_to_num(window.xy.T - seen_xy, nan=2.0 * camera.fx)
    residual = np.asarray(np.einsum("abm,bm->am", window.whitener, error_px))
    length = np.hypot(*residual)
    within = np.minimum(length, window.limit)
    cost = float((within * (length - 0.5 * within)).sum())
    if window.baseline is not None:
        cost += 0.5 * _along(window.baseline, state)[1] ** 2
    return Seen(state, R_cam_world, points, residual, length, cost)


def _along(baseline: Baseline, state: State) -> tuple[Array, float]:
    """Unit vector from the first view to the second, and what is missing to the length, in sigmas."""
    first, second = (state.T_world_cam[k, :3, 3] for k in baseline.views)
    length_map = float(np.linalg.norm(second - first))
    missing = (baseline.length_map - length_map) / baseline.sigma_map
    return (second - first) / max(length_map, _LEAST_LENGTH), missing


@dataclass(frozen=True)
class Normal:
    """Normal equations, with C unknowns of poses.

    Attributes:
        poses: ``(C, C)``.
        points: ``(P, 3, 3)``, each point for itself.
        both: ``(P, 3, C)``.
        right_poses: ``(C,)`` right side.
        right_points: ``(P, 3)`` right side.
    """

    poses: Array
    points: Array
    both: Array
    right_poses: Array
    right_points: Array

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Eliminate the points.

        Returns:
            The poses' system ``(C, C)``; the inverse Cholesky factors ``(P, 3, 3)`` of the points' own ones;
            and ``both`` multiplied by these, ``(3 P, C)``.

        Raises:
            LinAlgError: A point is not determined.
        """
        lower = np.asarray(np.linalg.cholesky(self.points + damping * np.eye(3)), np.float64)
        factor = _inverse_of_lower(lower)
        scaled = (factor @ self.both).reshape(3 * len(factor), len(self.poses))
        return self.poses + damping * np.eye(len(self.poses)) - scaled.T @ scaled, factor, scaled

    def step(self, damping: float) -> tuple[Array, Array, float]:
        """Solve: twists of poses ``(C,)``, moves of points ``(P, 3)``, and by how much the cost should fall.

        Raises:
            LinAlgError: The system is singular.
        """
        system, factor, scaled = self.reduced(damping)
        right = np.einsum("pij,pj->pi", factor, self.right_points)
        right_poses = self.right_poses - right.ravel() @ scaled
        twists = np.asarray(np.linalg.solve(system, right_poses), np.float64)
        moves: Array = np.einsum("pji,pj->pi", factor, right - (scaled @ twists).reshape(-1, 3))
        promised = twists @ self.right_poses + (moves * self.right_points).sum()
        promised += damping * (twists @ twists + (moves**2).sum())
        return twists, moves, 0.5 * float(promised)


def _inverse_of_lower(lower: Array) -> Array:
    """Inverses of lower triangular matrices ``(P, 3, 3)``, an element at a time for all of them."""
    inverse = np.zeros_like(lower)
    a, c, f = (1.0 / lower[:, k, k] for k in range(3))
    inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 2, 2] = a, c, f
    inverse[:, 1, 0] = -a * c * lower[:, 1, 0]
    inverse[:, 2, 1] = -c * f * lower[:, 2, 1]
    inverse[:, 2, 0] = -f * (a * lower[:, 2, 0] + inverse[:, 1, 0] * lower[:, 2, 1])
    return inverse


@dataclass(frozen=True)
class Slopes:
    """What each observation says of poses and points around a state, in standard deviations.

    Weighted by Huber's loss: products of slopes are information.

    Attributes:
        by_xyz: ``(2, 3, M)`` by the point, world frame.
        by_pose: ``(2, 6, F)`` by a twist of the camera in its own frame, of ``Window.of_free``.
        residual: ``(2, M)`` observed minus projected.
    """

    by_xyz: Array
    by_pose: Array
    residual: Array


def slopes_at(window: Window, seen: Seen) -> Slopes:
    """Return the slopes around a state."""
    x, y, z = seen.points_cam
    front = z > 0.0
    z = np.where(front, z, 1.0)
    weight = np.sqrt(np.minimum(1.0, window.limit / np.maximum(seen.length, 1e-12)))
    weight = np.where(front, weight, 0.0)
    by_x, by_y = (weight * window.whitener * (f / z) for f in (window.camera.fx, window.camera.fy))
    by_x, by_y = by_x[:, 0], by_y[:, 1]
    by_point = np.stack([by_x, by_y, -(by_x * x + by_y * y) / z], axis=1)
    by_xyz = np.einsum("aim,ijm->ajm", by_point, seen.R_cam_world)
    # Not by an index in brackets, here and below: that puts observations first in memory, and products then
    # take thrice as long.
    of_free = (values.take(window.of_free, axis=-1) for values in (by_point, seen.points_cam))
    return Slopes(by_xyz, _by_pose(*of_free), weight * seen.residual)


def linearise(window: Window, state: State, slopes: Slopes) -> Normal:
    """Return the normal equations around a state."""
    by_xyz, residual = slopes.by_xyz, slopes.residual
    own = _products(by_xyz, np.concatenate([by_xyz, residual[:, None]], axis=1))
    sums = [summed(window.point, row, window.num_points) for row in own.reshape(12, -1)]
    points = np.stack(sums, axis=1).reshape(window.num_points, 3, 4)
    rows, count = window.of_free, window.num_unknowns
    by_xyz, residual = (values.take(rows, axis=-1) for values in (by_xyz, residual))
    poses, right_poses = _poses_own(window, slopes.by_pose, residual)
    _hold_baseline(window, state, poses, right_poses)
    both = summed(window.place, _products(by_xyz, slopes.by_pose).ravel(), 3 * window.num_points * count)
    both = both.reshape(window.num_points, 3, count)
    return Normal(poses, points[..., :3], both, right_poses, points[..., 3])


def _by_pose(by_point: Array, points_cam: Array) -> Array:
    """Slopes ``(2, 6, F)`` by a twist of the camera in its own frame, of those ``(2, 3, F)`` by points."""
    x, y, z = points_cam
    by_x, by_y, by_z = by_point.transpose(1, 0, 2)
    turn = [by_y * z - by_z * y, by_z * x - by_x * z, by_x * y - by_y * x]
    return np.stack([*turn, -by_x, -by_y, -by_z], axis=1)


def summed(group: NDArray[np.intp], values: Array, num_groups: int) -> Array:
    """Sums of values ``(N,)`` over groups."""
    return np.asarray(np.bincount(group, values, num_groups), dtype=np.float64)


def _products(slopes0: Array, slopes1: Array) -> Array:
    """Each observation's products of slopes ``(2, I, M)`` and ``(2, J, M)``: ``(I, J, M)``."""
    return np.asarray(np.einsum("aim,ajm->ijm", slopes0, slopes1))


def _poses_own(window: Window, by_pose: Array, residual: Array) -> tuple[Array, Array]:
    """The poses' part ``(C, C)`` of normal equations, and its right side ``(C,)``."""
    slopes = np.concatenate([by_pose, residual[:, None]], axis=1).transpose(1, 0, 2)
    poses, right = np.zeros((window.num_unknowns, window.num_unknowns)), np.zeros(window.num_unknowns)
    ends = np.searchsorted(window.view[window.of_free], np.flatnonzero(window.free), side="right")
    for k, (since, end) in enumerate(pairwise((0, *ends.tolist()))):
        flat = slopes[:, :, since:end].reshape(7, -1)
        products = flat @ flat.T
        poses[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = products[:6, :6]
        right[6 * k : 6 * k + 6] = products[:6, 6]
    return poses, right


def _hold_baseline(window: Window, state: State, poses: Array, right_poses: Array) -> None:
    """Add what holds the baseline to the poses' part of normal equations."""
    if window.baseline is None:
        return
    direction, missing = _along(window.baseline, state)
    slope = np.zeros(window.num_unknowns)
    for view, sign in zip(window.baseline.views, (-1.0, 1.0), strict=True):
        if window.free[view]:
            at = window.first_unknown[view] + 3
            slope[at : at + 3] = sign * direction @ state.T_world_cam[view, :3, :3]
    slope /= window.baseline.sigma_map
    poses += np.outer(slope, slope)
    right_poses += missing * slope


def _moved(window: Window, state: State, twists: Array, moves: Array) -> State:
    T_world_cam = state.T_world_cam.copy()
    T_world_cam[window.free] = T_world_cam[window.free] @ exp_se3(twists.reshape(-1, 6))
    return State(T_world_cam, state.xyz + moves)


def minimise(window: Window, state: State, iterations: int) -> State:
    """Return the state after so many steps at most; the one it began with where none makes it better."""
    seen, damping = see(window, state), _FIRST_DAMPING
    for _ in range(iterations):
        better, damping = _better(window, seen, damping)
        if better is None:
            break
        before, seen = seen.cost, better
        if before - seen.cost <= max(_SMALL_SHARE * before, _SMALL):
            break
    return seen.state


def _better(window: Window, seen: Seen, damping: float) -> tuple[Seen | None, float]:
    """Find a damping with which a step is worth it: where that leads to, or None, and the next damping."""
    normal = linearise(window, seen.state, slopes_at(window, seen))
    while damping < _MAX_DAMPING:
        try:
            twists, moves, promised = normal.step(damping)
        except np.linalg.LinAlgError:
            promised = -1.0
        if promised >= 0.0:
            moved = see(window, _moved(window, seen.state, twists, moves))
            fall = seen.cost - moved.cost
            if fall > _MIN_KEPT_PROMISE * promised > 0.0:
                return moved, damping / _DAMPING_FACTOR
            if abs(fall) < _SMALL_SHARE * seen.cost:
                break
        damping *= _DAMPING_FACTOR
    return None, damping
