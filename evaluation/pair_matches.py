"""Matched points of two decoded images, with everything that may speak of their reliability."""

from dataclasses import dataclass, fields
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import DecodedImage
from semcast.server.geometry.corners import corner_strength, deduplicate, detect_corners
from semcast.server.geometry.edges import edges_at
from semcast.server.geometry.grey import to_grey
from semcast.server.geometry.klt import track_points
from semcast.server.geometry.sampling import sample_map
from semcast.server.geometry.weighting import fuse_confidence

Array = NDArray[np.float64]
Features = Literal["klt", "orb", "sift"]

#: Lowe's test: the best descriptor must be nearer than the second best by this factor.
_RATIO = {"orb": 0.85, "sift": 0.8}
#: Matches nearer than this to another one say nothing new and would weigh twice.
_DUPLICATE_PX = 1.0


@dataclass(frozen=True)
class PairMatches:
    """Matches between two images; all arrays have N rows.

    Attributes:
        keypoints0_xy: ``(N, 2)`` pixels in the first image.
        keypoints1_xy: ``(N, 2)`` pixels in the second image.
        confidence0: ``(N,)`` the codec's pixel confidence at the first end.
        confidence1: ``(N,)`` at the second end.
        keypoint_confidence0: ``(N,)`` the codec's keypoint confidence at the first end, or None.
        keypoint_confidence1: ``(N,)`` at the second end, or None.
        gradient0_grey2: ``(N,)`` smaller eigenvalue of the structure tensor at the first end, mean per pixel.
        gradient1_grey2: ``(N,)`` at the second end: of the tracked window for KLT.
        forward_backward_px: ``(N,)`` way there and back of a KLT track; None for descriptors.
        photometric_grey: ``(N,)`` difference of the windows of a KLT track; None for descriptors.
        edge0: ``(N, 2)`` edges at the first ends, along which they are known less, see ``edges``.
        edge1: ``(N, 2)`` edges at the second ends.
    """

    keypoints0_xy: Array
    keypoints1_xy: Array
    confidence0: Array
    confidence1: Array
    keypoint_confidence0: Array | None
    keypoint_confidence1: Array | None
    gradient0_grey2: Array
    gradient1_grey2: Array
    forward_backward_px: Array | None
    photometric_grey: Array | None
    edge0: Array
    edge1: Array

    def __len__(self) -> int:
        return len(self.keypoints0_xy)

    def take(self, idx: NDArray[np.intp]) -> "PairMatches":
        """Return the matches with these indices."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        taken: dict[str, Any] = {k: None if v is None else v[idx] for k, v in values.items()}
        return PairMatches(**taken)

    @property
    def confidence(self) -> Array:
        """``(N,)`` fused pixel confidence (Eq. 16 of the paper)."""
        return fuse_confidence(self.confidence0, self.confidence1)

    @property
    def keypoint_confidence(self) -> Array | None:
        """``(N,)`` fused keypoint confidence, or None."""
        if self.keypoint_confidence0 is None or self.keypoint_confidence1 is None:
            return None
        return fuse_confidence(self.keypoint_confidence0, self.keypoint_confidence1)

    @property
    def cues(self) -> dict[str, NDArray[np.float32]]:
        """Return what may tell right matches from wrong ones, higher for right."""
        cues = {
            "confidence": self.confidence,
            "corner_strength": np.minimum(self.gradient0_grey2, self.gradient1_grey2),
        }
        keypoint_confidence = self.keypoint_confidence
        if keypoint_confidence is not None:
            cues["keypoint_confidence"] = keypoint_confidence
        if self.forward_backward_px is not None:
            cues["forward_backward"] = -self.forward_backward_px
        if self.photometric_grey is not None:
            cues["photometric"] = -self.photometric_grey
        return {name: values.astype(np.float32) for name, values in cues.items()}


def match_pair(
    decoded0: DecodedImage, decoded1: DecodedImage, features: Features, max_features: int
) -> PairMatches:
    """Match points between two decoded images.

    ``klt`` follows the server's corners by Lucas-Kanade there and back, as its tracker does; ``orb`` and
    ``sift`` match descriptors that are each other's nearest and pass Lowe's ratio test.

    Args:
        decoded0: First image with confidence.
        decoded1: Second image, same shape.
        features: How to match.
        max_features: Keypoints per image at most.
    """
    grey0, grey1 = to_grey(decoded0.image), to_grey(decoded1.image)
    forward_backward_px = photometric_grey = None
    strength0 = corner_strength(grey0)
    if features == "klt":
        corners = detect_corners(grey0, max_features, strength=strength0).astype(np.float64)
        tracked = track_points(grey0, grey1, corners, corners)
        found = np.flatnonzero(tracked.ok)
        xy0, xy1 = corners[found], tracked.xy[found]
        gradient1_grey2 = tracked.gradient_grey2[found]
        forward_backward_px = tracked.forward_backward_px[found]
        photometric_grey = tracked.photometric_grey[found]
    else:
        xy0, xy1 = _match_descriptors(grey0, grey1, features, max_features)
        gradient1_grey2 = sample_map(corner_strength(grey1), xy1)
    c0, c1 = decoded0.keypoint_confidence, decoded1.keypoint_confidence
    has_keypoint_confidence = c0 is not None and c1 is not None
    matches = PairMatches(
        keypoints0_xy=xy0,
        keypoints1_xy=xy1,
        confidence0=sample_map(decoded0.confidence, xy0),
        confidence1=sample_map(decoded1.confidence, xy1),
        keypoint_confidence0=sample_map(c0, xy0) if has_keypoint_confidence and c0 is not None else None,
        keypoint_confidence1=sample_map(c1, xy1) if has_keypoint_confidence and c1 is not None else None,
        gradient0_grey2=sample_map(strength0, xy0),
        gradient1_grey2=gradient1_grey2,
        forward_backward_px=forward_backward_px,
        photometric_grey=photometric_grey,
        edge0=edges_at(grey0, xy0),
        edge1=edges_at(grey1, xy1),
    )
    keep = deduplicate(xy0, _DUPLICATE_PX) & deduplicate(xy1, _DUPLICATE_PX)
    return matches.take(np.flatnonzero(keep))


def _match_descriptors(
    grey0: NDArray[np.uint8], grey1: NDArray[np.uint8], features: Features, max_features: int
) -> tuple[Array, Array]:
    """Detect, describe and match; best first."""
    detector = (
        cv2.ORB.create(nfeatures=max_features)
        if features == "orb"
        else cv2.SIFT.create(nfeatures=max_features)
    )
    keypoints0, descriptors0 = detector.detectAndCompute(grey0, None)
    keypoints1, descriptors1 = detector.detectAndCompute(grey1, None)
    none = np.zeros((0, 2))
    if descriptors0 is None or descriptors1 is None or min(len(keypoints0), len(keypoints1)) < 2:
        return none, none
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if features == "orb" else cv2.NORM_L2)
    forward = matcher.knnMatch(descriptors0, descriptors1, k=2)
    backward = {m.queryIdx: m.trainIdx for m in matcher.match(descriptors1, descriptors0)}
    good = [
        best
        for best, second in (pair for pair in forward if len(pair) == 2)
        if best.distance < _RATIO[features] * second.distance and backward.get(best.trainIdx) == best.queryIdx
    ]
    good.sort(key=lambda m: m.distance)
    if not good:
        return none, none
    xy0 = np.array([keypoints0[m.queryIdx].pt for m in good], dtype=np.float64)
    xy1 = np.array([keypoints1[m.trainIdx].pt for m in good], dtype=np.float64)
    return xy0, xy1
