"""Confidence-free relative-pose estimators, run on the same matches as ours."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform
from semcast.server.geometry.lo_ransac import MIN_INLIERS, lo_ransac
from semcast.server.geometry.ransac import confidence_ransac

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CompetitorSettings:
    """Budget of a competitor.

    Attributes:
        threshold_px: Inlier threshold on the epipolar error.
        success_prob: Confidence at which the search may stop.
        max_iterations: Upper bound of hypotheses.
        seed: Seed of PoseLib's sampler; OpenCV's is fixed.
    """

    threshold_px: float = 1.0
    success_prob: float = 0.9999
    max_iterations: int = 10_000
    seed: int = 0


#: By default OpenCV ignores points more than 50 baselines away when it chooses among the four poses, and with
#: short baselines finds none at all.
_ANY_DISTANCE = 1e9

Competitor = Callable[[Array, Array, Intrinsics, CompetitorSettings], Array | None]


def _opencv(
    keypoints0_xy: Array, keypoints1_xy: Array, camera: Intrinsics, settings: CompetitorSettings, method: int
) -> Array | None:
    """Essential matrix and cheirality by OpenCV; None for degenerate matches."""
    if len(keypoints0_xy) < 5:
        return None
    K = camera.K
    try:
        E, inliers = cv2.findEssentialMat(
            keypoints0_xy,
            keypoints1_xy,
            K,
            method=method,
            prob=settings.success_prob,
            threshold=settings.threshold_px,
            maxIters=settings.max_iterations,
        )
        # USAC gives None or an empty matrix when it finds nothing; the 5-point solver may stack solutions.
        if E is None or E.ndim != 2 or E.shape[1] != 3 or len(E) < 3 or not np.isfinite(E).all():
            return None
        mask = None if inliers is None else inliers.copy()
        num_good, R_cam1_cam0, t_cam1_cam0, _, _ = cv2.recoverPose(
            E[:3], keypoints0_xy, keypoints1_xy, K, distanceThresh=_ANY_DISTANCE, mask=mask
        )
    except cv2.error:
        return None
    return make_transform(R_cam1_cam0, t_cam1_cam0) if num_good > 0 else None


def opencv_ransac(
    keypoints0_xy: Array, keypoints1_xy: Array, camera: Intrinsics, settings: CompetitorSettings
) -> Array | None:
    """Plain RANSAC over the five-point solver: what people use, and compare with.

    Args:
        keypoints0_xy: ``(N, 2)`` pixels in the first image.
        keypoints1_xy: ``(N, 2)`` matched pixels in the second image.
        camera: Both images' camera, without distortion.
        settings: Budget.

    Returns:
        ``T_cam1_cam0`` with a translation of length 1, or None when nothing was found.
    """
    return _opencv(keypoints0_xy, keypoints1_xy, camera, settings, cv2.RANSAC)


def opencv_magsac(
    keypoints0_xy: Array, keypoints1_xy: Array, camera: Intrinsics, settings: CompetitorSettings
) -> Array | None:
    """USAC with MAGSAC++ scoring; arguments and result as ``opencv_ransac``."""
    return _opencv(keypoints0_xy, keypoints1_xy, camera, settings, cv2.USAC_MAGSAC)


def poselib_lo_ransac(
    keypoints0_xy: Array, keypoints1_xy: Array, camera: Intrinsics, settings: CompetitorSettings
) -> Array | None:
    """LO-RANSAC of PoseLib with its final refinement; arguments and result as ``opencv_ransac``."""
    if len(keypoints0_xy) < MIN_INLIERS:
        return None
    options = {
        "max_epipolar_error": settings.threshold_px,
        "success_prob": settings.success_prob,
        "max_iterations": settings.max_iterations,
        "seed": settings.seed,
    }
    return lo_ransac(camera, keypoints0_xy, keypoints1_xy, options)


def plain_ransac(
    keypoints0_xy: Array, keypoints1_xy: Array, camera: Intrinsics, settings: CompetitorSettings
) -> Array | None:
    """The paper's own RANSAC without confidence: uniform sampling, one threshold, most inliers.

    What separates it from mode ``paper`` is confidence alone: it has the algebraic residual of Eq. 18 and
    that mode's threshold, whatever the settings say. Arguments and result as ``opencv_ransac``.
    """
    ones = np.ones(len(keypoints0_xy))
    return confidence_ransac(camera, keypoints0_xy, keypoints1_xy, ones, seed=settings.seed)


#: Name in results -> estimator.
COMPETITORS: dict[str, Competitor] = {
    "plain_ransac": plain_ransac,
    "opencv_ransac": opencv_ransac,
    "opencv_magsac": opencv_magsac,
    "poselib": poselib_lo_ransac,
}
