"""Bundle adjustment of a window of keyframes with GTSAM: one noise model per observation.

Traps held off here: ``Rot3`` of a matrix that is not orthonormal ends the interpreter, so rotations are
projected first; a landmark behind a camera gives a silently bad minimum, so depths are checked first.
"""

import time

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, project_to_so3
from semcast.server.geometry.edges import rounded, whiteners
from semcast.server.geometry.projection import project_in_front
from semcast.server.geometry.weighting import HUBER_K
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult
from semcast.server.mapping.left_over import information

Array = NDArray[np.float64]

#: Observations share noise models: their sigmas are rounded to so many steps.
NUM_SIGMAS = 16
SIGMA_RANGE_PX = (0.1, 12.0)
#: With fewer there is no window, but what is left of one.
_MIN_OBSERVATIONS = 10
#: Holds a fixed pose: radians and map units.
_FIXED_SIGMA = 1e-6


def quantised_sigma(sigma_px: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the shared sigmas, ``(16,)`` pixels in equal ratios, and each observation's step, ``(M,)``."""
    low, high = np.log(SIGMA_RANGE_PX[0]), np.log(SIGMA_RANGE_PX[1])
    position = (np.log(np.clip(sigma_px, *SIGMA_RANGE_PX)) - low) / (high - low) * (NUM_SIGMAS - 1)
    return np.exp(np.linspace(low, high, NUM_SIGMAS)), np.rint(position).astype(np.intp)


def residuals_px(problem: BundleProblem, T_world_cam: Array, xyz: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Observed minus projected, and which observations have the landmark in front.

    Args:
        problem: Whose observations.
        T_world_cam: ``(K, 4, 4)`` poses to take instead of the problem's.
        xyz: ``(P, 3)`` points in the world frame, as well.

    Returns:
        ``(M, 2)`` pixels, NaN where the landmark is not in front of the camera, and ``(M,)`` bool.
    """
    T_cam_world = invert_transform(T_world_cam)[problem.view]
    points_cam = np.einsum("mij,mj->mi", T_cam_world[:, :3, :3], xyz[problem.point]) + T_cam_world[:, :3, 3]
    projected, front = project_in_front(problem.camera, points_cam)
    return np.where(front[:, None], problem.xy - projected, np.nan), front


def _noise_model(
    sigma_px: float, huber_px: float | None, edge: tuple[float, float]
) -> gtsam.noiseModel.Robust:
    """Return Huber's loss of the residual over sigma.

    GTSAM puts the weight inside the loss. With a limit of ``huber_px / sigma`` that is ``sigma^-2`` times the
    loss of the residual in pixels, as in Eq. 22.
    """
    limit = HUBER_K if huber_px is None else huber_px / sigma_px
    huber = gtsam.noiseModel.mEstimator.Huber.Create(limit)
    if edge == (0.0, 0.0):
        return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(2, sigma_px))
    root = whiteners(np.array([edge]))[0] / sigma_px
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Information(root @ root))


def _build(
    problem: BundleProblem, used: NDArray[np.bool_]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fixed_noise = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    for k, T in enumerate(problem.T_world_cam):
        pose = gtsam.Pose3(gtsam.Rot3(project_to_so3(T[:3, :3])), T[:3, 3])
        values.insert(X(k), pose)
        if problem.fixed[k]:
            graph.add(gtsam.PriorFactorPose3(X(k), pose, fixed_noise))
    if problem.keep_baseline and len(problem.T_world_cam) > 1:
        away = np.linalg.norm(problem.T_world_cam[:, :3, 3] - problem.T_world_cam[0, :3, 3], axis=1)
        # The longest one: a camera that came back to where it began would say nothing about the scale.
        furthest = int(away.argmax())
        baseline = float(away[furthest])
        noise = gtsam.noiseModel.Isotropic.Sigma(1, max(1e-4 * baseline, 1e-9))
        graph.add(gtsam.RangeFactorPose3(X(0), X(furthest), baseline, noise))
    for p in np.unique(problem.point[used]).tolist():
        values.insert(L(p), problem.xyz[p])
    sigmas, step = quantised_sigma(problem.sigma_px)
    shapes = rounded(problem.edge).tolist()
    models: dict[tuple[int, float, float], gtsam.noiseModel.Robust] = {}
    camera = problem.camera
    calibration = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    factor = gtsam.GenericProjectionFactorCal3_S2
    pose_keys = [X(k) for k in range(len(problem.T_world_cam))]
    rows = np.flatnonzero(used)
    for row, xy, s, k, p in zip(
        rows.tolist(),
        problem.xy[rows],
        step[rows].tolist(),
        problem.view[rows].tolist(),
        problem.point[rows].tolist(),
        strict=True,
    ):
        kind = (s, *shapes[row])
        if kind not in models:
            models[kind] = _noise_model(float(sigmas[s]), problem.huber_px, kind[1:])
        graph.add(factor(xy, models[kind], pose_keys[k], L(p), calibration))
    return graph, values


def optimise(problem: BundleProblem) -> BundleResult:
    """Adjust a window; never raises on degenerate input, poses and pixels that are not finite included.

    Observations are left out where the landmark is behind the camera or seen by no other view.
    """
    started = time.perf_counter_ns()
    residual, front = residuals_px(problem, problem.T_world_cam, problem.xyz)
    count = np.bincount(problem.point[front], minlength=len(problem.xyz))
    used = front & (count[problem.point] >= 2) & np.isfinite(problem.xy).all(axis=1)
    T_world_cam, xyz, covariance, ok = problem.T_world_cam.copy(), problem.xyz.copy(), None, False
    is_posed = bool(np.isfinite(problem.T_world_cam).all())
    if int(used.sum()) >= _MIN_OBSERVATIONS and problem.fixed.any() and is_posed:
        graph, values = _build(problem, used)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(problem.iterations)
        parameters.setRelativeErrorTol(1e-3)
        parameters.setlambdaInitial(1e-4)
        try:
            optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
            before = optimiser.error()
            solved = optimiser.optimize()
            ok = bool(np.isfinite(optimiser.error()) and optimiser.error() <= before)
        except (RuntimeError, IndexError):  # an indeterminate system, a pose without a factor
            ok = False
        if ok:
            for k in np.flatnonzero(~problem.fixed).tolist():
                pose = solved.atPose3(X(k)).matrix()
                T_world_cam[k] = pose
            points = np.unique(problem.point[used])
            xyz[points] = np.array([solved.atPoint3(L(p)) for p in points.tolist()])
            ok = bool(np.isfinite(T_world_cam).all() and np.isfinite(xyz).all())
            if ok and problem.with_covariance:
                covariance = _covariance(graph, solved, len(T_world_cam) - 1)
        if not ok:
            T_world_cam, xyz = problem.T_world_cam.copy(), problem.xyz.copy()
    residual, _ = residuals_px(problem, T_world_cam, xyz)
    residual[~used] = np.nan
    left_over = None
    if ok and problem.motion is not None:
        left_over = information(problem, problem.motion, T_world_cam, xyz, residual)
    elapsed_ms = (time.perf_counter_ns() - started) * 1e-6
    return BundleResult(problem, ok, T_world_cam, xyz, residual, covariance, elapsed_ms, left_over)


def _covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int) -> Array | None:
    """Marginal covariance of one pose, None where the system does not fix it."""
    try:
        covariance = np.asarray(gtsam.Marginals(graph, values).marginalCovariance(X(k)))
    except (RuntimeError, IndexError):  # IndexError: no observation is left on this pose
        return None
    return covariance if np.isfinite(covariance).all() else None


class InlineBundle:
    """Adjusts in the caller's thread: the same input gives the same result, bit for bit."""

    def __init__(self) -> None:
        self._result: BundleResult | None = None

    @property
    def busy(self) -> bool:
        """A result waits to be taken."""
        return self._result is not None

    def submit(self, problem: BundleProblem) -> bool:
        """Adjust now; the result waits for ``take``."""
        if self._result is not None:
            return False
        self._result = optimise(problem)
        return True

    def take(self, wait: bool = False) -> BundleResult | None:
        """Return the result of the last ``submit``, once."""
        result, self._result = self._result, None
        return result

    def close(self) -> None:
        """Forget a result that was not taken."""
        self._result = None
