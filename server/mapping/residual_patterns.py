"""What the residuals of a bundle adjustment say about its assumptions: a global shutter and a known lens.

An adjustment gives all rows of an image one pose and takes the lens for known. Where that is wrong, points
are displaced by a pattern that is known but for its size, such as their flow times the time at which their
row was read. Poses and points explain some of the pattern; the rest stays in the residuals, in proportion to
its size. The size is therefore the one unknown of a linear least squares problem: both residuals and pattern
are projected onto what poses and points can't explain (Schur complement), and then compared.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, skew
from semcast.server.geometry.edges import whiteners
from semcast.server.geometry.projection import MIN_DEPTH_MAP, projection_jacobian
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult, ViewMotion

Array = NDArray[np.float64]

#: The patterns in their order: the residuals themselves; a second of readout along rows, along columns; a
#: focal length twice as long; a first and a second radial coefficient of 1; a principal point further to the
#: right and down, by a focal length; what was put right for a readout, as it was before.
RESIDUAL, ROWS, COLUMNS, FOCAL, RADIAL, RADIAL_2, CENTRE_X, CENTRE_Y, PUT_RIGHT = range(9)
NUM_PATTERNS = 9
#: Residuals beyond this many medians count less (Huber).
_HUBER_MEDIANS = 1.5
#: Damping that holds the gauge, as a share of the mean of the diagonal.
_DAMPING = 1e-6
#: Step of the numerical derivative of a distortion, in normalised image coordinates.
_STEP = 1e-5
#: An estimate counts when it is this many standard deviations from 0,
LEAST_SIGMAS = 5.0
#: and explains this share of the squared residuals. Lenses that were right explained up to .008, with values
#: up to ten of their standard deviations from 0, and global shutters up to .015, behind bad links.
LEAST_EXPLAINED = 0.03
#: Groups of views, one left out at a time, by which an estimate's standard deviation is found (jackknife).
NUM_GROUPS = 10


def pattern_products_of(
    problem: BundleProblem, motion: ViewMotion, T_world_cam: Array, xyz: Array, residual_px: Array
) -> Array:
    """Return what each view's residuals say: inner products of all patterns, residuals included.

    From each pattern, what a change of poses and points explains of it is subtracted first.

    Args:
        problem: The one that was adjusted, of a window's number of views: the algebra is dense.
        motion: Of its views.
        T_world_cam: ``(K, 4, 4)`` after the adjustment.
        xyz: ``(P, 3)`` after the adjustment.
        residual_px: ``(M, 2)``, NaN where not used.

    Returns:
        ``(K, 9, 9)``, in the order of ``RESIDUAL``, ``ROWS`` ...; zero for views of unknown velocity.
    """
    num_views, num_points = len(T_world_cam), len(xyz)
    T_cam_world = invert_transform(T_world_cam)[problem.view]
    points = np.einsum("mij,mj->mi", T_cam_world[:, :3, :3], xyz[problem.point]) + T_cam_world[:, :3, 3]
    used = np.isfinite(residual_px).all(axis=1) & (points[:, 2] > MIN_DEPTH_MAP)
    used &= np.isfinite(motion.velocity[problem.view]).all(axis=1)
    told = np.zeros((num_views, NUM_PATTERNS, NUM_PATTERNS))
    if not used.any():
        return told
    view, point, points = problem.view[used], problem.point[used], points[used]
    whitener = whiteners(problem.edge[used])
    camera = problem.camera
    by_point = projection_jacobian(camera, points)
    by_pose = by_poses(by_point, points)
    by_xyz = by_point @ T_cam_world[used, :3, :3]
    flow = np.einsum("mij,mj->mi", by_pose, motion.velocity[view])
    put_right_px = np.zeros_like(residual_px) if motion.put_right_px is None else motion.put_right_px
    share = shares_of_readout(motion.size_wh, (problem.xy + put_right_px)[used])
    patterns = np.stack(
        [
            residual_px[used],
            share[:, 1:] * flow,
            share[:, :1] * flow,
            *_lens_patterns((camera.fx, camera.fy), motion.distortion, points[:, :2] / points[:, 2:]),
            put_right_px[used],
        ],
        axis=2,
    )
    error, sigma_px = (whitener @ residual_px[used, :, None])[..., 0], problem.sigma_px[used]
    # What a readout does to points is no outlier: if it counted as one, a shorter one would be found.
    for _ in range(2):
        trust = _weights(error, sigma_px)
        weight = trust[:, None, None] * whitener
        left = _unexplained(
            weight @ by_pose, weight @ by_xyz, weight @ patterns, view, point, (num_views, num_points)
        )
        error = _without_readout(left) / trust[:, None]
    np.add.at(told, view, np.einsum("mkg,mkh->mgh", left, left))
    return told


def _lens_patterns(focal_px: tuple[float, float], distortion: tuple[float, ...], ray: Array) -> list[Array]:
    """Return the derivatives of pixels by the lens, ``(M, 2)`` each, from ``FOCAL`` to ``CENTRE_Y``.

    Images were undistorted with the lens that was assumed. Where it is another one, that was done at the
    wrong places, which the inverse derivative of the distortion makes up for. A change of focal length leaves
    distortion as it is in pixels.

    Args:
        focal_px: fx, fy.
        distortion: OpenCV coefficients.
        ray: ``(M, 2)`` with unit depth.
    """
    r2 = (ray**2).sum(axis=1, keepdims=True)
    across, down = np.zeros((2, len(ray), 2))
    across[:, 0], down[:, 1] = 1.0, 1.0
    changes = [ray * r2, ray * r2**2, across, down]
    if any(distortion):
        slope = _slope(ray, distortion)
        changes = [np.linalg.solve(slope, change[..., None])[..., 0] for change in changes]
    return [change * focal_px for change in (ray, *changes)]


def _slope(ray: Array, distortion: tuple[float, ...]) -> Array:
    """Return the derivative of distortion, ``(M, 2, 2)``, at rays ``(M, 2)`` of unit depth."""
    lens, still = np.array(distortion), np.zeros(3)

    def seen(at: Array) -> Array:
        points = np.column_stack([at, np.ones(len(at))])
        pixels = cv2.projectPoints(points, still, still, np.eye(3), lens)[0]
        return np.asarray(pixels, np.float64).reshape(-1, 2)

    steps = _STEP * np.eye(2)
    return np.stack([(seen(ray + step) - seen(ray - step)) / (2 * _STEP) for step in steps], axis=2)


def shares_of_readout(size_wh: tuple[int, int], xy: Array) -> Array:
    """Return when each pixel is read, ``(M, 2)`` if columns or rows are read in turn.

    In shares of the readout after the middle one: from -0.5 to 0.5.
    """
    last = np.maximum(np.array(size_wh, dtype=np.float64) - 1.0, 1.0)
    return np.asarray(xy / last - 0.5)


def by_poses(by_point: Array, points_cam: Array) -> Array:
    """Return the derivatives of pixels by the camera's pose in its own frame, ``(M, 2, 6)``."""
    return np.concatenate([by_point @ skew(points_cam), -by_point], axis=2)


def _without_readout(left: Array) -> Array:
    """Return residuals ``(M, 2)`` without the readout that explains most of them.

    Args:
        left: ``(M, 2, G)`` weighted, what poses and points leave of residuals and patterns.
    """
    readouts = left[..., [ROWS, COLUMNS]].reshape(-1, 2)
    explains = np.linalg.lstsq(readouts, left[..., RESIDUAL].ravel(), rcond=None)[0]
    return np.asarray(left[..., RESIDUAL] - left[..., [ROWS, COLUMNS]] @ explains)


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


class PatternEvidence:
    """Collects the pattern products of keyframes over all adjustments so far.

    Windows overlap: what a keyframe says in several adjustments is added up, and it stays one independent
    witness. Also counts observations and unknowns, since unknowns that were fitted to the observations have
    made residuals smaller than the errors they stand for.
    """

    def __init__(self) -> None:
        self._told: dict[int, Array] = {}
        self._num_observed = self._num_fitted = 0

    def __len__(self) -> int:
        return len(self._told)

    @property
    def views(self) -> list[Array]:
        """What each keyframe's residuals say, see ``pattern_products_of``, in order of time."""
        return [self._told[frame_id] for frame_id in sorted(self._told)]

    @property
    def sigma_factor(self) -> float:
        """Factor on standard deviations for the degrees of freedom that fitted unknowns have taken.

        Infinite where there are as many unknowns as observations: such residuals say nothing.
        """
        share_left = 1.0 - self._num_fitted / self._num_observed if self._num_observed else 1.0
        return share_left**-0.5 if share_left > 0.0 else np.inf

    def note(self, result: BundleResult) -> None:
        """Add the residuals of an adjustment, if it was asked for them."""
        if result.pattern_products is None:
            return
        for frame_id, told in zip(result.problem.keyframe_ids.tolist(), result.pattern_products, strict=True):
            self._told[frame_id] = self._told.get(frame_id, 0.0) + told
        used = np.isfinite(result.residual_px).all(axis=1)
        num_views, num_points = (len(np.unique(k[used])) for k in (result.problem.view, result.problem.point))
        self._num_observed += 2 * int(used.sum())
        self._num_fitted += 6 * num_views + 3 * num_points


def grouped(views: Sequence[Array] | Array) -> Array | None:
    """Return sums over groups of consecutive views, ``(G, 9, 9)``; None where fewer than three say something.

    Args:
        views: ``(9, 9)`` of each, as ``pattern_products_of`` gives them.
    """
    each = np.asarray(views, dtype=np.float64).reshape(-1, NUM_PATTERNS, NUM_PATTERNS)
    each = each[each[:, RESIDUAL, RESIDUAL] > 0.0]
    if len(each) < 3:
        return None
    num_groups = min(NUM_GROUPS, len(each))
    group = np.arange(len(each)) * num_groups // len(each)
    return np.stack([each[group == k].sum(axis=0) for k in range(num_groups)])


def spread(estimates: Array) -> float:
    """Return the standard deviation of an estimate from those that each leave out a group (jackknife)."""
    count = len(estimates)
    return float(np.sqrt((count - 1) / count * ((estimates - estimates.mean()) ** 2).sum()))
