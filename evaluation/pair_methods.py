"""Estimators of the pair benchmark: ours in every confidence mode and the competitors, one signature."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.competitors import COMPETITORS, CompetitorSettings
from semcast.evaluation.pair_matches import PairMatches
from semcast.server.two_view import estimate_two_view
from semcast.server.weighting import ConfidenceMode, KeypointCues, observation_confidence

Array = NDArray[np.float64]

#: Matches, camera, inlier threshold in pixels and seed to ``T_cam1_cam0``, or None.
Estimator = Callable[[PairMatches, Intrinsics, float, int], Array | None]

_ABLATION_STREAM = 0xAB1A


def match_confidence(mode: ConfidenceMode, matches: PairMatches, seed: int) -> Array:
    """Return the ``c`` of each match that the estimator is given in a mode, ``(N,)`` in [0, 1].

    The weighting is the server's; of both ends of a match the less trusted counts (Eq. 16 of the paper).
    Descriptor matches have no track, so nothing is known of its way back or its windows.
    """
    none = np.zeros(len(matches))
    cues = KeypointCues(
        pixel_confidence=matches.confidence,
        keypoint_confidence=matches.keypoint_confidence,
        gradient_grey2=matches.gradient_grey2,
        forward_backward_px=none if matches.forward_backward_px is None else matches.forward_backward_px,
        photometric_grey=none if matches.photometric_grey is None else matches.photometric_grey,
    )
    return observation_confidence(mode, cues, np.random.default_rng((seed, _ABLATION_STREAM)))


def confidence_estimator(mode: ConfidenceMode) -> Estimator:
    """Return the server's two-view estimator in a confidence mode."""

    def estimate(matches: PairMatches, camera: Intrinsics, threshold_px: float, seed: int) -> Array | None:
        found = estimate_two_view(
            camera,
            matches.keypoints0_xy,
            matches.keypoints1_xy,
            match_confidence(mode, matches, seed),
            mode=mode,
            threshold_px=threshold_px,
            seed=seed,
        )
        return None if found is None else found.T_cam1_cam0

    return estimate


def competitor_estimator(name: str) -> Estimator:
    """Return a competitor by its name in ``COMPETITORS``."""
    competitor = COMPETITORS[name]

    def estimate(matches: PairMatches, camera: Intrinsics, threshold_px: float, seed: int) -> Array | None:
        how = CompetitorSettings(threshold_px=threshold_px, seed=seed)
        return competitor(matches.keypoints0_xy, matches.keypoints1_xy, camera, how)

    return estimate
