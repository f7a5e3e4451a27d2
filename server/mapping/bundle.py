"""Bundle adjustment with a noise model per observation: of a window by dense algebra, or else by GTSAM.

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
from semcast.server.mapping.dense_bundle import Baseline, State, Window, minimise
from semcast.server.mapping.pose_graph import FIXED_SIGMA, PoseConstraint
from semcast.server.mapping.residual_patterns import pattern_products_of
from semcast.server.mapping.window_covariance import window_covariance
from semcast.server.worker import Inline

Array = NDArray[np.float64]

#: Poses and points.
_Solved = tuple[Array, Array]

#: Observations share noise models: their sigmas are rounded to this many steps
NUM_SIGMAS = 16
#: in equal ratios within this range.
SIGMA_RANGE_PX = (0.1, 12.0)
#: Free views that dense algebra is for: its time grows with their square and the number of points.
_MAX_DENSE_VIEWS = 60
#: With fewer there is no window, but what is left of one.
_MIN_OBSERVATIONS = 10


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


def _baseline(problem: BundleProblem) -> Baseline | None:
    """Return what holds the scale: the longest way from the newest fixed view, as a camera may come back.

    Fixed views of long ago are no end of it: a way between two of them holds nothing, and one from far aside
    hardly changes with the scale.
    """
    if not problem.keep_baseline or problem.fixed.all():
        return None
    newest = int(np.flatnonzero(problem.fixed)[-1])
    away = np.linalg.norm(problem.T_world_cam[:, :3, 3] - problem.T_world_cam[newest, :3, 3], axis=1)
    furthest = int(np.where(problem.fixed, -1.0, away).argmax())
    length_map = float(away[furthest])
    return Baseline((newest, furthest), length_map, max(1e-4 * length_map, 1e-9))


def _step(constraint: PoseConstraint) -> gtsam.BetweenFactorPose3:
    T = constraint.T_first_second
    between = gtsam.Pose3(gtsam.Rot3(project_to_so3(T[:3, :3])), T[:3, 3])
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(constraint.sigma[:2], 3))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K), noise)
    return gtsam.BetweenFactorPose3(X(constraint.first), X(constraint.second), between, robust)


def _build(
    problem: BundleProblem, used: NDArray[np.bool_]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fixed_noise = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    for k, T in enumerate(problem.T_world_cam):
        pose = gtsam.Pose3(gtsam.Rot3(project_to_so3(T[:3, :3])), T[:3, 3])
        values.insert(X(k), pose)
        if problem.fixed[k]:
            graph.add(gtsam.PriorFactorPose3(X(k), pose, fixed_noise))
    if (held := _baseline(problem)) is not None:
        noise = gtsam.noiseModel.Isotropic.Sigma(1, held.sigma_map)
        first, furthest = held.views
        graph.add(gtsam.RangeFactorPose3(X(first), X(furthest), held.length_map, noise))
    for constraint in problem.steps:
        graph.add(_step(constraint))
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
    solved: _Solved | None = None
    is_posed = bool(np.isfinite(problem.T_world_cam).all())
    if int(used.sum()) >= _MIN_OBSERVATIONS and problem.fixed.any() and is_posed:
        is_small = not problem.steps and int((~problem.fixed).sum()) <= _MAX_DENSE_VIEWS
        is_dense = problem.solver == "dense" and is_small
        solved = (_by_dense_algebra if is_dense else _by_gtsam)(problem, used)
    ok = solved is not None
    T_world_cam, xyz = solved or (problem.T_world_cam.copy(), problem.xyz.copy())
    residual, _ = residuals_px(problem, T_world_cam, xyz)
    residual[~used] = np.nan
    covariances = None
    if ok and problem.with_covariance:
        window, _, points = _window_of(problem, used)
        adjusted = State(T_world_cam, xyz[points])
        covariances = window_covariance(window, adjusted, sets_unit=problem.sets_unit)
    pattern_products = None
    if ok and problem.motion is not None:
        pattern_products = pattern_products_of(problem, problem.motion, T_world_cam, xyz, residual)
    elapsed_ms = (time.perf_counter_ns() - started) * 1e-6
    return BundleResult(problem, ok, T_world_cam, xyz, residual, covariances, elapsed_ms, pattern_products)


def _window_of(problem: BundleProblem, used: NDArray[np.bool_]) -> tuple[Window, State, NDArray[np.intp]]:
    """Return what dense algebra is given, where it begins, and which points these are."""
    points, point = np.unique(problem.point[used], return_inverse=True)
    sigma_px = np.clip(problem.sigma_px[used], *SIGMA_RANGE_PX)
    window = Window(
        camera=problem.camera,
        free=~problem.fixed,
        num_points=len(points),
        view=problem.view[used],
        point=point,
        xy=problem.xy[used],
        whitener=whiteners(problem.edge[used]).transpose(1, 2, 0) / sigma_px,
        limit=np.full(len(sigma_px), HUBER_K) if problem.huber_px is None else problem.huber_px / sigma_px,
        baseline=_baseline(problem),
    )
    return window, State(problem.T_world_cam, problem.xyz[points]), points


def _by_dense_algebra(problem: BundleProblem, used: NDArray[np.bool_]) -> _Solved | None:
    window, state, points = _window_of(problem, used)
    solved = minimise(window, state, problem.iterations)
    T_world_cam, xyz = solved.T_world_cam.copy(), problem.xyz.copy()
    for k in np.flatnonzero(window.free).tolist():
        T_world_cam[k, :3, :3] = project_to_so3(T_world_cam[k, :3, :3])
    xyz[points] = solved.xyz
    if not (np.isfinite(T_world_cam).all() and np.isfinite(xyz).all()):
        return None
    return T_world_cam, xyz


def _by_gtsam(problem: BundleProblem, used: NDArray[np.bool_]) -> _Solved | None:
    graph, values = _build(problem, used)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(problem.iterations)
    parameters.setRelativeErrorTol(1e-3)
    parameters.setlambdaInitial(1e-4)
    try:
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        before = optimiser.error()
        solved = optimiser.optimize()
    except (RuntimeError, IndexError):  # an indeterminate system, a pose without a factor
        return None
    if not (np.isfinite(optimiser.error()) and optimiser.error() <= before):
        return None
    T_world_cam, xyz = problem.T_world_cam.copy(), problem.xyz.copy()
    for k in np.flatnonzero(~problem.fixed).tolist():
        T_world_cam[k] = solved.atPose3(X(k)).matrix()
    points = np.unique(problem.point[used])
    xyz[points] = np.array([solved.atPoint3(L(p)) for p in points.tolist()])
    if not (np.isfinite(T_world_cam).all() and np.isfinite(xyz).all()):
        return None
    return T_world_cam, xyz


class InlineBundle(Inline[BundleProblem, BundleResult]):
    """Adjusts in the caller's thread: the same input gives the same result, bit for bit."""

    def __init__(self) -> None:
        super().__init__(optimise)
