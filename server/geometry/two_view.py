"""Relative pose of two images from matches.

``robust``: PoseLib's LO-RANSAC three times, each at two thresholds: drawing uniformly from all matches,
uniformly from those that move as their neighbours do, and among these the trusted ones first. Beside what
they find stand the best motions near pure turning. The poses, each with its translation either way, are
judged by how near matches are to the halves of their epipolar lines in front of the cameras; the score knows
the agreement, but not confidence, and holds a little against turning, since few matches are often explained
as well by a large turn that the camera never made. Then comes a refinement whose weights, and as how much of
an edge its errors count, are fitted to this pair's own residuals. A misleading confidence can therefore cost
time, hardly accuracy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform, project_to_so3, rotation_angle_deg
from semcast.common.shapes import check_shape
from semcast.server.geometry.agreement import neighbour_agreement
from semcast.server.geometry.epipolar import (
    Shapes,
    depths,
    fit_rotation,
    fundamental_matrix,
    half_line_px,
    most_in_front,
    msac_score,
    rays_angle_deg,
    refine_relative_pose,
    rotation_residual_px,
    sampson_px,
    shape_of,
)
from semcast.server.geometry.lo_ransac import lo_ransac
from semcast.server.geometry.ransac import confidence_ransac, in_front
from semcast.server.geometry.weighting import ConfidenceMode, NoiseModel, fit_noise

Array = NDArray[np.float64]

MIN_MATCHES = 8
#: Thresholds of the searches and of the score, in units of the one that is asked for.
_THRESHOLD_FACTORS = (1.0, 2.0)
_SCORE_FACTORS = (0.5, 1.0, 2.0, 4.0)
#: A match that fewer of its neighbours agree with is in the first search alone, not in the refinement.
_MIN_AGREEMENT = 0.25
#: Where more than this share of the matches agree, a search among these alone is the first one over again.
_NEARLY_ALL = 0.9
#: Agreement from which on the weight of a match in the score rises, and where it reaches 1.
_AGREEMENT_RANGE = (0.1, 0.4)
#: The weight below that.
_LEAST_WEIGHT = 0.05
#: What turning costs a pose in the choice among several, in matches of full weight per root of a degree:
#: frames follow one another, and where two motions explain the matches alike the smaller turn is likelier.
_TURN_COST = 0.3
#: Factor by which a later candidate must be better than the first one: the score's own noise.
_TO_DISPLACE = 1.001
#: Confidences that differ by no more than this are all alike and give no order.
_ALIKE = 1e-6
#: Matches by which the motions near pure turning are sought, at most.
_MAX_TURNING_MATCHES = 100
#: Steps of each of those searches.
_TURNING_STEPS = 6
#: Points near the camera have larger errors and most of the information: the fitted beta overstates what
#: confidence is worth, half of it does best.
_BETA_SHARE = 0.5
#: Standard deviations at which errors are cut off in the refinement,
_CUT_SIGMAS = 2.5
#: and the least that is believed of a pair, however well its matches fit.
_MIN_SIGMA_PX = 0.1


#: Shares of the edges that errors may have.
_SHARES = (0.25, 0.5, 0.75, 1.0)
#: Log-likelihood that a share must gain over none: what a parameter costs (Akaike).
_SHARE_SURE = 1.0
#: No match is known to lie nearer to its line than that.
_LEAST_PX = 1e-6


@dataclass(frozen=True)
class TwoViewResult:
    """Relative pose of two images.

    Attributes:
        T_cam1_cam0: ``(4, 4)``, translation of length 1.
        inliers: ``(N,)`` bool: near the epipolar geometry and in front of both cameras.
        is_rotation: Turning alone explains the matches, and the translation has no meaning; False where
            that was not asked.
        parallax_deg: Median angle between the rays of inliers.
    """

    T_cam1_cam0: Array
    inliers: NDArray[np.bool_]
    is_rotation: bool
    parallax_deg: float


def estimate_two_view(
    camera: Intrinsics,
    keypoints0_xy: Array,
    keypoints1_xy: Array,
    confidence: Array | None = None,
    *,
    edges: tuple[Array, Array] | None = None,
    mode: ConfidenceMode = "robust",
    threshold_px: float = 1.0,
    seed: int = 0,
    max_iterations: int = 300,
    min_iterations: int = 100,
    choose_model: bool = False,
) -> TwoViewResult | None:
    """Estimate the relative pose of two images.

    Args:
        camera: Of both images, without distortion.
        keypoints0_xy: ``(N, 2)`` pixels.
        keypoints1_xy: ``(N, 2)`` pixels, matched row by row.
        confidence: ``(N,)`` in [0, 1], from ``weighting``; None is the same as mode ``off``.
        edges: ``(N, 2)`` of the keypoints of both images, see ``edges``: known to the refinement, except in
            mode ``paper``. None where errors have no direction.
        mode: ``paper`` is the paper's RANSAC; ``off`` knows no confidence; all others search in order of it
            too and refine with fitted weights.
        threshold_px: Inlier threshold on the Sampson distance.
        seed: Of the searches.
        max_iterations: Hypotheses of one search at most.
        min_iterations: Hypotheses of one search at least.
        choose_model: Also try a plane and a pure rotation, as a start of a map needs it.

    Returns:
        The result, or None with fewer than 8 matches, pixels that are not finite, or when nothing was found.

    Raises:
        ValueError: Shapes disagree, the camera has distortion, or an argument is out of range.
    """
    xy0, xy1 = _checked_matches(camera, keypoints0_xy, keypoints1_xy, confidence, edges, mode, threshold_px)
    if len(xy0) < MIN_MATCHES or not (np.isfinite(xy0).all() and np.isfinite(xy1).all()):
        return None
    if mode == "paper" and confidence is not None:
        T_paper = _as_in_the_paper(camera, xy0, xy1, confidence, threshold_px, seed)
        return None if T_paper is None else _result(camera, T_paper, xy0, xy1, threshold_px, choose_model)
    if confidence is not None and (mode == "off" or float(np.ptp(confidence)) <= _ALIKE):
        confidence = None
    agreement = neighbour_agreement(xy0, xy1)
    kept = _kept(agreement)
    how = {"seed": seed, "max_iterations": max_iterations, "min_iterations": min_iterations}
    candidates = _searched(camera, xy0, xy1, kept, confidence, threshold_px, how)
    candidates += _near_turning(camera, xy0[kept], xy1[kept], threshold_px)
    if choose_model:
        candidates += _from_plane(camera, xy0, xy1, threshold_px, seed)
    T_found = _likeliest(camera, candidates, xy0, xy1, _weights(agreement), threshold_px)
    if T_found is None:
        return None
    trusted = None if confidence is None else confidence[kept]
    shapes = None
    if edges is not None:
        shapes = _shapes(
            camera, T_found, xy0[kept], xy1[kept], (edges[0][kept], edges[1][kept]), threshold_px
        )
    T = _refine(camera, T_found, xy0[kept], xy1[kept], shapes, trusted, threshold_px)
    return _result(camera, T, xy0, xy1, threshold_px, choose_model)


def search_closely(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    *,
    threshold_px: float,
    seed: int,
    min_iterations: int,
    max_iterations: int,
) -> TwoViewResult | None:
    """Return the motion that explains the most matches to within a small threshold, however the others move.

    ``estimate_two_view`` weighs several thresholds, since the noise is not known beforehand: of two motions
    it prefers one that explains all matches badly to one that explains most of them well.

    Args:
        camera: Of both images, without distortion.
        xy0: ``(N, 2)`` pixels, finite.
        xy1: ``(N, 2)`` pixels, matched row by row.
        threshold_px: Inlier threshold on the Sampson distance.
        seed: Of the search.
        min_iterations: Hypotheses at least.
        max_iterations: Hypotheses at most.
    """
    T = _search(
        camera,
        xy0,
        xy1,
        threshold_px,
        in_order=False,
        seed=seed,
        max_iterations=max_iterations,
        min_iterations=min_iterations,
    )
    T = _likeliest(camera, [T], xy0, xy1, np.ones(len(xy0)), threshold_px)
    return None if T is None else _result(camera, T, xy0, xy1, threshold_px, choose_model=True)


def _checked_matches(
    camera: Intrinsics,
    keypoints0_xy: Array,
    keypoints1_xy: Array,
    confidence: Array | None,
    edges: tuple[Array, Array] | None,
    mode: str,
    threshold_px: float,
) -> tuple[Array, Array]:
    """Check what was asked; the matches as PoseLib takes them."""
    xy0 = np.ascontiguousarray(keypoints0_xy, dtype=np.float64)
    xy1 = np.ascontiguousarray(keypoints1_xy, dtype=np.float64)
    check_shape(xy0, "N 2", "keypoints0_xy")
    check_shape(xy1, f"{len(xy0)} 2", "keypoints1_xy")
    if confidence is not None:
        check_shape(confidence, f"{len(xy0)}", "confidence")
    for edge in edges or ():
        check_shape(edge, f"{len(xy0)} 2", "edges")
    if mode not in get_args(ConfidenceMode):
        raise ValueError(f"mode must be one of {', '.join(get_args(ConfidenceMode))}, got {mode!r}")
    if not threshold_px > 0.0:
        raise ValueError(f"threshold_px must be positive, got {threshold_px:g}")
    if camera.is_distorted:
        raise ValueError(f"camera must be without distortion, got {camera.distortion}")
    return xy0, xy1


def _as_in_the_paper(
    camera: Intrinsics, xy0: Array, xy1: Array, confidence: Array, threshold_px: float, seed: int
) -> Array | None:
    """The pose of the paper's RANSAC, None where it finds none."""
    T = confidence_ransac(camera, xy0, xy1, confidence, seed=seed)
    if T is None:
        return None
    near = _near_lines(camera, T, xy0, xy1, threshold_px)
    return most_in_front(camera, (T, make_transform(T[:3, :3], -T[:3, 3])), xy0[near], xy1[near])


def _searched(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    kept: NDArray[np.intp],
    confidence: Array | None,
    threshold_px: float,
    how: Mapping[str, int],
) -> list[Array | None]:
    """What the searches find, at two thresholds each."""
    return [
        _search(camera, xy0[rows], xy1[rows], factor * threshold_px, in_order=in_order, **how)
        for factor in _THRESHOLD_FACTORS
        for rows, in_order in _orders_of_drawing(len(xy0), kept, confidence)
    ]


def _orders_of_drawing(
    count: int, kept: NDArray[np.intp], confidence: Array | None
) -> list[tuple[NDArray[np.intp], bool]]:
    """Matches of each search, and whether it draws the first of them first."""
    orders: list[tuple[NDArray[np.intp], bool]] = [(np.arange(count), False)]
    if len(kept) < _NEARLY_ALL * count:
        orders.append((kept, False))
    if confidence is not None:
        orders.append((kept[np.argsort(-confidence[kept], kind="stable")], True))
    return orders


def _likeliest(
    camera: Intrinsics,
    candidates: Sequence[Array | None],
    xy0: Array,
    xy1: Array,
    weight: Array,
    threshold_px: float,
) -> Array | None:
    """The pose that explains the matches best at the least turn, its translation either way."""
    judged: list[tuple[float, int, Array]] = []
    for k, candidate in enumerate(candidates):
        if candidate is None:
            continue
        turn_cost = _TURN_COST * float(np.sqrt(rotation_angle_deg(candidate[:3, :3])) / weight.sum())
        for way in (1.0, -1.0):  # a search tells the translation up to its sign
            T = make_transform(candidate[:3, :3], way * candidate[:3, 3])
            cost = _score(camera, T, xy0, xy1, threshold_px, weight) + turn_cost
            judged.append((cost if k == 0 else _TO_DISPLACE * cost, k, T))
    if not judged:
        return None
    return min(judged, key=lambda item: item[:2])[2]


def _kept(agreement: Array) -> NDArray[np.intp]:
    """Matches that move like their neighbours; the better half where they are too few."""
    kept = np.flatnonzero(agreement >= _MIN_AGREEMENT)
    if len(kept) < MIN_MATCHES:
        kept = np.sort(np.argsort(-agreement, kind="stable")[: max(MIN_MATCHES, len(agreement) // 2)])
    return kept


def _weights(agreement: Array) -> Array:
    """Weight of each match in the score."""
    low, high = _AGREEMENT_RANGE
    return np.clip((agreement - low) / (high - low), _LEAST_WEIGHT, 1.0)


def _score(camera: Intrinsics, T: Array, xy0: Array, xy1: Array, threshold_px: float, weight: Array) -> float:
    """MSAC score without confidence over the distances to epipolar half lines.

    It is the mean over several thresholds, because the noise of decoded images is not known beforehand.
    Which half tells the two poses of a plane apart, which fit the epipolar constraint equally well.
    """
    residual = half_line_px(camera, T, xy0, xy1)
    return float(np.mean([msac_score(residual, factor * threshold_px, weight) for factor in _SCORE_FACTORS]))


def _behind(camera: Intrinsics, T: Array, xy0: Array, xy1: Array, threshold_px: float) -> NDArray[np.bool_]:
    """Points behind a camera, beyond what noise does to points without parallax."""
    depth0, depth1 = depths(camera, T, xy0, xy1)
    sure = rays_angle_deg(camera, T, xy0, xy1) > np.degrees(2.0 * threshold_px / camera.fx)
    return np.asarray(sure & ((depth0 <= 0) | (depth1 <= 0)))


def follows(
    camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array, threshold_px: float
) -> NDArray[np.bool_]:
    """Which matches a relative pose explains, ``(N,)``: inliers, and points too far away to be behind.

    Args:
        camera: Of both images.
        T_cam1_cam0: ``(4, 4)`` relative pose.
        xy0: ``(N, 2)`` pixels.
        xy1: ``(N, 2)`` pixels, matched row by row.
        threshold_px: Inlier threshold of the search.
    """
    near = _near_lines(camera, T_cam1_cam0, xy0, xy1, threshold_px)
    return near & ~_behind(camera, T_cam1_cam0, xy0, xy1, threshold_px)


def _near_lines(
    camera: Intrinsics, T: Array, xy0: Array, xy1: Array, threshold_px: float
) -> NDArray[np.bool_]:
    """Which matches are within two thresholds of their epipolar lines, ``(N,)``."""
    return np.asarray(np.abs(sampson_px(fundamental_matrix(camera, T), xy0, xy1)) < 2.0 * threshold_px)


def _search(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    threshold_px: float,
    *,
    in_order: bool,
    seed: int,
    max_iterations: int,
    min_iterations: int,
) -> Array | None:
    """PoseLib's LO-RANSAC; in order, it draws the first matches first."""
    options = {
        "max_epipolar_error": threshold_px,
        "success_prob": 0.9999,
        "max_iterations": max_iterations,
        "min_iterations": min_iterations,
        "seed": seed,
        "progressive_sampling": in_order,
    }
    found = lo_ransac(camera, xy0, xy1, options)
    return None if found is None else make_transform(project_to_so3(found[:3, :3]), found[:3, 3])


def _near_turning(camera: Intrinsics, xy0: Array, xy1: Array, threshold_px: float) -> list[Array]:
    """Poses near the turn that explains the matches best, with a translation from each axis on, both ways."""
    rows = np.linspace(0, len(xy0) - 1, min(len(xy0), _MAX_TURNING_MATCHES)).astype(np.intp)
    xy0, xy1 = xy0[rows], xy1[rows]
    R = fit_rotation(camera, xy0, xy1)
    sigma_px = np.full(len(rows), 2.0 * threshold_px)
    return [
        refine_relative_pose(camera, make_transform(R, axis), xy0, xy1, sigma_px, iterations=_TURNING_STEPS)
        for axis in (*np.eye(3), *-np.eye(3))
    ]


def _from_plane(
    camera: Intrinsics, xy0: Array, xy1: Array, threshold_px: float, seed: int
) -> list[Array | None]:
    """Poses of the plane most matches lie on; none where no plane stands out."""
    options = {"max_reproj_error": 2.0 * threshold_px, "max_iterations": 500, "seed": seed}
    H, info = poselib.estimate_homography(xy0, xy1, options, {})
    if info["num_inliers"] < max(MIN_MATCHES, 0.5 * len(xy0)) or not np.isfinite(H).all():
        return []
    on_plane = np.asarray(info["inliers"], dtype=bool)
    K = camera.K
    poses, _ = poselib.motion_from_homography(np.linalg.inv(K) @ np.asarray(H) @ K)
    starts: list[Array] = []
    for pose in poses:
        t = np.asarray(pose.t, dtype=np.float64)
        length = float(np.linalg.norm(t))
        if not np.isfinite(length) or length < 1e-9 or not np.isfinite(pose.R).all():
            continue
        T = make_transform(project_to_so3(pose.R), t / length)
        T = in_front(camera, T, xy0[on_plane], xy1[on_plane])
        # Each pose comes twice, with the plane before and behind the camera.
        if not any(np.allclose(T, other, atol=1e-6) for other in starts):
            starts.append(T)
    sigma_px = np.full(len(xy0), 0.5 * threshold_px)
    return [refine_relative_pose(camera, T, xy0, xy1, sigma_px) for T in starts]


def _shapes(
    camera: Intrinsics, T: Array, xy0: Array, xy1: Array, edges: tuple[Array, Array], threshold_px: float
) -> Shapes | None:
    """Shapes of errors as far as the matches near a pose bear them out.

    Where images tell a point across an edge only, its error has the shape of the structure tensor; where
    descriptors or a blurred image place it, hardly any. Which share of the edges makes the distances to the
    epipolar lines likeliest (Laplace) is asked of this pair, as its noise is. None where no share does.
    """
    F = fundamental_matrix(camera, T)
    distance = np.abs(sampson_px(F, xy0, xy1))
    near = distance < 3.0 * threshold_px
    if int(near.sum()) < MIN_MATCHES:
        return None
    xy0, xy1, distance = xy0[near], xy1[near], distance[near] + _LEAST_PX
    least, likeliest = float(len(distance) * np.log(distance.mean())) - _SHARE_SURE, None
    for share in _SHARES:
        shapes = shape_of(share * edges[0]), shape_of(share * edges[1])
        shaped = np.abs(sampson_px(F, xy0, xy1, (shapes[0][near], shapes[1][near]))) + _LEAST_PX
        cost = float(len(distance) * np.log(shaped.mean()) - np.log(shaped / distance).sum())
        if cost < least:
            least, likeliest = cost, shapes
    return likeliest


def _refine(
    camera: Intrinsics,
    T: Array,
    xy0: Array,
    xy1: Array,
    shapes: Shapes | None,
    confidence: Array | None,
    threshold_px: float,
) -> Array:
    """Refine with the noise fitted to this pair; with equal weights where confidence tells nothing."""
    residual = half_line_px(camera, T, xy0, xy1, shapes)
    near = residual < 3.0 * threshold_px
    if int(near.sum()) < MIN_MATCHES:
        return T
    sigma = np.ones(len(xy0))
    model = fit_noise(confidence[near], residual[near]) if confidence is not None else None
    if model is not None and confidence is not None:
        sigma = NoiseModel(1.0, _BETA_SHARE * model.beta).sigma_px(confidence)
    scale_px = float(np.median(residual[near] / sigma[near])) / 0.6745
    sigma_px = max(scale_px, _MIN_SIGMA_PX) * sigma
    return refine_relative_pose(camera, T, xy0, xy1, sigma_px, shapes=shapes, cut_sigmas=_CUT_SIGMAS)


def _result(
    camera: Intrinsics,
    T: Array,
    xy0: Array,
    xy1: Array,
    threshold_px: float,
    choose_model: bool,
) -> TwoViewResult:
    near = _near_lines(camera, T, xy0, xy1, threshold_px)
    depth0, depth1 = depths(camera, T, xy0, xy1)
    inliers = near & (depth0 > 0) & (depth1 > 0)
    angle = rays_angle_deg(camera, T, xy0, xy1)
    is_rotation = False
    if choose_model and near.any():
        R = fit_rotation(camera, xy0[near], xy1[near])
        turned = rotation_residual_px(camera, R, xy0[near], xy1[near]) < 3.0 * threshold_px
        is_rotation = bool(turned.mean() > 0.8)
    parallax = float(np.median(angle[inliers])) if inliers.any() else 0.0
    return TwoViewResult(T, inliers, is_rotation, parallax)
