"""Estimators of the pair benchmark: ours in every confidence mode and the competitors, one signature."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.competitors import COMPETITORS, CompetitorSettings
from semcast.evaluation.pair_matches import PairMatches
from semcast.server.geometry.two_view import estimate_two_view
from semcast.server.geometry.weighting import (
    ConfidenceMode,
    KeypointCues,
    fuse_confidence,
    observation_confidence,
)

Array = NDArray[np.float64]

#: Matches, camera, inlier threshold in pixels and seed to ``T_cam1_cam0``, or None.
Estimator = Callable[[PairMatches, Intrinsics, float, int], Array | None]

_ABLATION_STREAM = 0xAB1A
#: What the server's tracks assume of a corner that was never followed.
NEW_CORNER_PX = 0.1


def match_confidence(mode: ConfidenceMode, matches: PairMatches, seed: int) -> Array:
    """Return the ``c`` of each match that the estimator is given in a mode, ``(N,)`` in [0, 1].

    It is the server's way: cues of each end become the confidence of that end, and of both the smaller counts
    (Eq. 16 of the paper). The first end is a corner found anew, as the server's tracks begin; the second has
    the way back and the windows of its track. Descriptor matches have no track, so nothing is known of those.
    """
    rng = np.random.default_rng((seed, _ABLATION_STREAM))
    none = np.zeros(len(matches))
    tracked = matches.forward_backward_px is not None
    first = KeypointCues(
        pixel_confidence=matches.confidence0,
        keypoint_confidence=matches.keypoint_confidence0,
        gradient_grey2=matches.gradient0_grey2,
        forward_backward_px=np.full(len(matches), NEW_CORNER_PX if tracked else 0.0),
        photometric_grey=none,
    )
    second = KeypointCues(
        pixel_confidence=matches.confidence1,
        keypoint_confidence=matches.keypoint_confidence1,
        gradient_grey2=matches.gradient1_grey2,
        forward_backward_px=none if matches.forward_backward_px is None else matches.forward_backward_px,
        photometric_grey=none if matches.photometric_grey is None else matches.photometric_grey,
    )
    ends = (observation_confidence(mode, cues, rng) for cues in (first, second))
    return fuse_confidence(*ends)


def confidence_estimator(mode: ConfidenceMode) -> Estimator:
    """Return the server's two-view estimator in a confidence mode.

    All but ``paper`` are told the shape of errors, ``off`` too: it is no confidence, and confidence alone is
    to separate ``off`` from the others.
    """

    def estimate(matches: PairMatches, camera: Intrinsics, threshold_px: float, seed: int) -> Array | None:
        found = estimate_two_view(
            camera,
            matches.keypoints0_xy,
            matches.keypoints1_xy,
            match_confidence(mode, matches, seed),
            edges=(matches.edge0, matches.edge1),
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
