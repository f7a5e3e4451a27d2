"""The paper's confidence-weighted RANSAC, to the letter (Sec. V-B, Eq. 14 to 20).

Weighted sampling without replacement, algebraic residual, confidence-adaptive threshold, choice by the number
of inliers. It is kept for comparison; ``two_view`` in mode ``robust`` is what the system runs on.
"""

import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform
from semcast.server.geometry.epipolar import essential_matrix, most_in_front
from semcast.server.geometry.weighting import adaptive_threshold, sampling_probability

Array = NDArray[np.float64]

#: Size of a minimal subset of the five-point algorithm.
SUBSET_SIZE = 5


def draw_weighted(
    probability: Array, size: int, num_draws: int, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Draw subsets without replacement, each next element in proportion to its probability.

    Gumbel's trick: the ``size`` largest of ``log q_i + Gumbel noise`` are distributed exactly so.

    Args:
        probability: ``(N,)``, sums to 1; an element with 0 is drawn only when no other is left.
        size: Elements of a subset, at most N.
        num_draws: Number of subsets.
        rng: Source of randomness.

    Returns:
        ``(num_draws, size)`` indices, in the order they were drawn.
    """
    with np.errstate(divide="ignore"):
        log_q = np.log(probability)
    log_q = np.where(np.isfinite(log_q), log_q, -1e9)
    keys = log_q + rng.gumbel(size=(num_draws, len(probability)))
    return np.asarray(np.argsort(-keys, axis=1, kind="stable")[:, :size])


def algebraic_residual(E: Array, rays0: Array, rays1: Array) -> Array:
    """``|p1^T E p0|`` (Eq. 18) for unit-depth rays: ``(N,)``, or ``(B, N)`` for ``(B, 3, 3)`` matrices."""
    return np.asarray(np.abs((rays1 * (rays0 @ np.swapaxes(E, -1, -2))).sum(axis=-1)))


def confidence_ransac(
    camera: Intrinsics,
    keypoints0_xy: Array,
    keypoints1_xy: Array,
    confidence: Array,
    *,
    num_trials: int = 500,
    seed: int = 0,
) -> Array | None:
    """Estimate a relative pose as the paper does.

    Args:
        camera: Of both images.
        keypoints0_xy: ``(N, 2)``.
        keypoints1_xy: ``(N, 2)``, matched row by row.
        confidence: ``(N,)`` fused confidence in [0, 1].
        num_trials: Subsets drawn.
        seed: Of the sampler.

    Returns:
        The model with the most inliers, ``T_cam1_cam0 (4, 4)`` with a translation of length 1; None when no
        subset gave one with more than five.
    """
    if len(confidence) < SUBSET_SIZE + 1:
        return None
    rays0, rays1 = camera.unproject(keypoints0_xy), camera.unproject(keypoints1_xy)
    # On normalised coordinates a pixel is one over the focal length.
    delta = adaptive_threshold(confidence, 1.0 / camera.fx)
    unit0 = rays0 / np.linalg.norm(rays0, axis=1, keepdims=True)
    unit1 = rays1 / np.linalg.norm(rays1, axis=1, keepdims=True)
    rng = np.random.default_rng(seed)
    subsets = draw_weighted(sampling_probability(confidence), SUBSET_SIZE, num_trials, rng)
    best: tuple[int, Array] | None = None
    for subset in subsets:
        poses = [
            make_transform(pose.R, np.asarray(pose.t) / max(1e-12, float(np.linalg.norm(pose.t))))
            for pose in poselib.relpose_5pt(unit0[subset], unit1[subset])
        ]
        poses = [T for T in poses if np.isfinite(T).all()]
        if not poses:
            continue
        E = np.stack([essential_matrix(T) for T in poses])
        counts = (algebraic_residual(E, rays0, rays1) < delta).sum(axis=1)
        top = int(counts.argmax())
        if best is None or counts[top] > best[0]:
            best = (int(counts[top]), poses[top])
    if best is None or best[0] <= SUBSET_SIZE:
        return None
    T_cam1_cam0 = best[1]
    inliers = algebraic_residual(essential_matrix(T_cam1_cam0), rays0, rays1) < delta
    return in_front(camera, T_cam1_cam0, keypoints0_xy[inliers], keypoints1_xy[inliers])


def in_front(camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array) -> Array:
    """Of the four poses with the same essential matrix, the one with most points in front of both cameras.

    Args:
        camera: Of both images.
        T_cam1_cam0: ``(4, 4)`` one of the four; its translation must have a length.
        xy0: ``(N, 2)`` pixels.
        xy1: ``(N, 2)`` pixels, matched row by row.

    Returns:
        ``(4, 4)``; the one that was given where others have no more points in front.
    """
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    twisted = (2.0 * np.outer(t, t) / float(t @ t) - np.eye(3)) @ R
    candidates = [make_transform(r, sign * t) for r in (R, twisted) for sign in (1.0, -1.0)]
    return most_in_front(camera, candidates, xy0, xy1)
