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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform, rotation_angle_deg
from semcast.common.shapes import check_shape
from semcast.server.geometry.agreement import neighbour_agreement
from semcast.server.geometry.epipolar import (
    depths,
    fit_rotation,
    fundamental_matrix,
    half_line_px,
    most_in_front,
    msac_score,
    rays_angle_deg,
    rotation_residual_px,
    sampson_px,
)
from semcast.server.geometry.ransac import confidence_ransac
from semcast.server.geometry.two_view_candidates import (
    MIN_MATCHES,
    from_plane,
    near_turning,
    search,
    searched,
)
from semcast.server.geometry.two_view_refinement import refine_to_own_noise, shapes_of_errors
from semcast.server.geometry.weighting import ConfidenceMode

Array = NDArray[np.float64]

#: Thresholds of the score, in units of the one that is asked for.
_SCORE_FACTORS = (0.5, 1.0, 2.0, 4.0)
#: A match that fewer of its neighbours agree with is in the first search alone, not in the refinement.
_MIN_AGREEMENT = 0.25
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
    candidates = searched(camera, xy0, xy1, kept, confidence, threshold_px, how)
    candidates += near_turning(camera, xy0[kept], xy1[kept], threshold_px)
    if choose_model:
        candidates += from_plane(camera, xy0, xy1, threshold_px, seed)
    T_found = _likeliest(camera, candidates, xy0, xy1, _weights(agreement), threshold_px)
    if T_found is None:
        return None
    trusted = None if confidence is None else confidence[kept]
    shapes = None
    if edges is not None:
        shapes = shapes_of_errors(
            camera, T_found, xy0[kept], xy1[kept], (edges[0][kept], edges[1][kept]), threshold_px
        )
    T = refine_to_own_noise(camera, T_found, xy0[kept], xy1[kept], shapes, trusted, threshold_px)
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
    T = search(
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
