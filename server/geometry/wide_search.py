"""Matches of two images however far points moved between them: SIFT, then one epipolar geometry.

A gap in the stream, a low frame rate or a jerk moves points further than a pyramid of Lucas-Kanade reaches,
and turns and scales what is around them. What is matched gives every point nearby a place to start from.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.server.geometry.grey import Grey
from semcast.server.geometry.square_distance import square_distances

Array = NDArray[np.float64]

#: Images whose sides are all at least this long are searched for features at half their width: SIFT doubles
#: it again, in a third of the time, and what is finer is noise in decoded images.
_MIN_REDUCED_PX = 320
#: Features of an image at most, the strongest.
_NUM_FEATURES = 2000
#: OpenCV doubles the image first and puts features this much too far right and down. Asked to do that
#: precisely, it finds a tenth fewer.
_SHIFT_PX = 0.25
#: SIFT's contrast threshold: decoded images are soft, so that weak features count.
_MIN_CONTRAST = 0.015
#: By this ratio of distances a nearest descriptor is clearly the nearest (Lowe 2004).
_MAX_RATIO = 0.8
#: Distance from its epipolar line up to which a match agrees.
_EPIPOLAR_PX = 3.0
#: Matches next to one, like whose median it must move,
_NEIGHBOURS = 7
#: but for this many pixels and for this share of that motion: depth may differ much.
_FREE_FLOW_PX, _FREE_FLOW_SHARE = 15.0, 0.5
#: Matches next to a point that the warp around it is fitted to.
_FITTED = 6
#: Those within this distance count alike.
_ALIKE_PX = 30.0
#: Share of their spread that holds the warp near the turns of the features: they may lie on a line.
_HELD_SHARE = 0.2
#: Matches that agree, at least; fewer prove nothing.
_MIN_AGREEING = 15
#: Nor does a share of all matches below this.
_MIN_AGREEING_SHARE = 0.4


@dataclass(frozen=True)
class WideFeatures:
    """SIFT features (Lowe 2004) of an image.

    Attributes:
        xy: ``(N, 2)`` pixels.
        size_px: ``(N,)`` diameter of each, in pixels of the reduced image.
        angle_rad: ``(N,)`` its direction, from x to y.
        descriptors: ``(N, 128)`` float32.
    """

    xy: Array
    size_px: Array
    angle_rad: Array
    descriptors: NDArray[np.float32]

    @staticmethod
    def of(grey: Grey, usable: NDArray[np.bool_] | None = None, *, fine: bool = False) -> "WideFeatures":
        """Find the features of an ``(H, W)`` image, where ``usable (H, W)`` is True.

        With ``fine`` they are looked for at full width: three times as many, and three times the time.
        """
        sift = cv2.SIFT.create(nfeatures=_NUM_FEATURES, contrastThreshold=_MIN_CONTRAST)
        height, width = grey.shape
        reduction = 2 if has_finer(grey) and not fine else 1
        size = (width // reduction, height // reduction)
        reduced = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        mask = None
        if usable is not None:
            mask = cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        found, descriptors = sift.detectAndCompute(reduced, mask)
        factor = np.array([width / size[0], height / size[1]])
        if descriptors is None:
            return WideFeatures(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.float32))
        return WideFeatures(
            xy=(np.array([k.pt for k in found], dtype=np.float64) + 0.5 - _SHIFT_PX) * factor - 0.5,
            size_px=np.array([k.size for k in found]),
            angle_rad=np.radians([k.angle for k in found]),
            descriptors=np.asarray(descriptors, dtype=np.float32),
        )


def has_finer(grey: Grey) -> bool:
    """Whether ``WideFeatures.of`` has finer features of an image: small ones are searched at full width."""
    return bool(min(grey.shape) >= _MIN_REDUCED_PX)


@dataclass(frozen=True)
class WideMatches:
    """Matches of two images, with how what is around them was turned and scaled.

    Attributes:
        from_xy: ``(M, 2)`` pixels in the first image.
        to_xy: ``(M, 2)`` pixels in the second.
        turns: ``(M, 2, 2)`` from offsets in the first image to those in the second.
    """

    from_xy: Array
    to_xy: Array
    turns: Array

    def carry(self, xy: Array, max_offset_px: float) -> tuple[NDArray[np.intp], Array]:
        """Take pixels ``(N, 2)`` of the first image to the second: for each match the one next to it.

        Args:
            xy: Pixels.
            max_offset_px: One further from its match is left out.

        Returns:
            Rows of those that were taken ``(K,)``, and where they come to lie ``(K, 2)``.
        """
        if len(xy) == 0 or len(self.from_xy) == 0:
            return np.zeros(0, np.intp), np.zeros((0, 2))
        square = square_distances(xy, self.from_xy)
        next_to = square.argmin(axis=0)
        away = square[next_to, np.arange(len(next_to))]
        near = np.flatnonzero(away < max_offset_px**2)
        near = near[np.argsort(away[near], kind="stable")]  # of several beside one pixel the nearest counts
        rows, first = np.unique(next_to[near], return_index=True)
        match = near[first]
        offset = np.einsum("nij,nj->ni", self.turns[match], xy[rows] - self.from_xy[match])
        return rows, self.to_xy[match] + offset


def match_wide(
    features0: WideFeatures, features1: WideFeatures, max_ratio: float = _MAX_RATIO
) -> WideMatches:
    """Match two images by descriptors that clearly have a nearest one; some matches are wrong.

    Args:
        features0: Of the first image.
        features1: Of the second.
        max_ratio: The nearest one must be nearer than this share of the distance to the second nearest.
    """
    if len(features1.xy) < 2:  # a lone one has no second nearest that it is nearer than
        return _turned(features0, features1, np.zeros(0, np.intp), np.zeros(0, np.intp))
    return _clearly_nearest(
        features0, features1, _square_descriptor_distances(features0, features1), max_ratio
    )


def _square_descriptor_distances(features0: WideFeatures, features1: WideFeatures) -> NDArray[np.float32]:
    """Squared distances of descriptors, ``(N, M)``; exact, as SIFT's are whole numbers of 512 in length.

    A matrix product takes a third of the time of OpenCV's matcher: ``(-2 a, aa, 1) (b, 1, bb)``.
    """
    (norm0, one0), (norm1, one1) = (
        (np.einsum("nk,nk->n", d, d)[:, None], np.ones((len(d), 1), np.float32))
        for d in (features0.descriptors, features1.descriptors)
    )
    from_left = np.hstack((-2.0 * features0.descriptors, norm0, one0))
    return np.asarray(from_left @ np.hstack((features1.descriptors, one1, norm1)).T)


def _clearly_nearest(
    features0: WideFeatures, features1: WideFeatures, apart: NDArray[np.float32], max_ratio: float
) -> WideMatches:
    """Match what is nearest, and clearly so, by squared distances ``(N, M)``, which are written over."""
    if apart.size == 0:
        return _turned(features0, features1, np.zeros(0, np.intp), np.zeros(0, np.intp))
    rows = np.arange(len(apart))
    best = apart.argmin(axis=1)
    nearest = apart[rows, best]
    apart[rows, best] = np.inf
    row0 = np.flatnonzero(nearest < max_ratio**2 * apart.min(axis=1))
    return _turned(features0, features1, row0, best[row0])


def _turned(
    features0: WideFeatures, features1: WideFeatures, row0: NDArray[np.intp], row1: NDArray[np.intp]
) -> WideMatches:
    """Matches of features, row by row, with how each was turned and scaled."""
    scale = features1.size_px[row1] / features0.size_px[row0]
    angle = features1.angle_rad[row1] - features0.angle_rad[row0]
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    turns = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
    return WideMatches(features0.xy[row0], features1.xy[row1], turns)


@dataclass(frozen=True)
class Carried:
    """Where points of one image are in another, roughly, and how what is around them was warped.

    Attributes:
        xy: ``(N, 2)`` pixels in the second image.
        warps: ``(N, 2, 2)`` derivatives of pixels there by those in the first image.
        num_matches: That say so, of the whole image.
    """

    xy: Array
    warps: Array
    num_matches: int


def match_near(
    features0: WideFeatures, features1: WideFeatures, expected_xy: Array, reach_px: float, max_ratio: float
) -> WideMatches:
    """Match as ``match_wide``, but only what is near where a feature is expected.

    What looks alike elsewhere, as in a row of equal doors, is no rival then; a lone one has none.

    Args:
        features0: Of the first image.
        features1: Of the second image.
        expected_xy: ``(N, 2)`` where those of the first are expected in the second, NaN for unknown.
        reach_px: How far from there they may be.
        max_ratio: As for ``match_wide``.
    """
    square = square_distances(expected_xy, features1.xy)
    apart = _square_descriptor_distances(features0, features1)
    apart[~(square < reach_px**2)] = np.inf
    return _clearly_nearest(features0, features1, apart, max_ratio)


def search_wide(features0: WideFeatures, features1: WideFeatures, xy0: Array) -> Carried | None:
    """Find where points of one image are in another, however far they moved.

    Args:
        features0: Of the image the points are known in.
        features1: Of the image they are looked for in.
        xy0: ``(N, 2)`` pixels in the first image.

    Returns:
        Places to look at, as the matches next to each point say. None where too few matches agree.
    """
    matches = match_wide(features0, features1)
    from_xy, flow = matches.from_xy, matches.to_xy - matches.from_xy
    if len(from_xy) < _MIN_AGREEING:
        return None
    agrees = epipolar_inliers(from_xy, matches.to_xy)
    if agrees is None or int(agrees.sum()) < max(_MIN_AGREEING, _MIN_AGREEING_SHARE * len(from_xy)):
        return None
    # A wrong match may lie on its epipolar line by chance; it hardly moves like the matches around it.
    agrees &= _moves_like_its_neighbours(from_xy, flow, agrees)
    if int(agrees.sum()) < _MIN_AGREEING:
        return None
    return _carried(WideMatches(from_xy[agrees], matches.to_xy[agrees], matches.turns[agrees]), xy0)


def _carried(matches: WideMatches, xy0: Array) -> Carried:
    """Fit an affine warp around each point ``(N, 2)`` to the matches next to it.

    A turning camera sees a surface beside it get narrower: where matches are says that, and a feature's own
    turn and scale don't.
    """
    square = square_distances(xy0, matches.from_xy)
    near = np.argsort(square, axis=1, kind="stable")[:, :_FITTED]
    weight = 1.0 / (np.take_along_axis(square, near, axis=1) + _ALIKE_PX**2)
    weight /= weight.sum(axis=1, keepdims=True)
    from_xy, to_xy = matches.from_xy[near], matches.to_xy[near]
    from_middle, to_middle = (np.einsum("nk,nki->ni", weight, xy) for xy in (from_xy, to_xy))
    from_offset, to_offset = from_xy - from_middle[:, None], to_xy - to_middle[:, None]
    spread = np.einsum("nk,nki,nkj->nij", weight, from_offset, from_offset)
    both = np.einsum("nk,nki,nkj->nij", weight, to_offset, from_offset)
    held = np.maximum(_HELD_SHARE * np.trace(spread, axis1=1, axis2=2), 1.0)[:, None, None]
    turn = np.median(matches.turns[near], axis=1)
    warps = (both + held * turn) @ np.linalg.inv(spread + held * np.eye(2))
    return Carried(to_middle + np.einsum("nij,nj->ni", warps, xy0 - from_middle), warps, len(matches.from_xy))


def epipolar_inliers(from_xy: Array, to_xy: Array) -> NDArray[np.bool_] | None:
    """Matches that agree on one epipolar geometry, ``(N,)``, None where none is found.

    Args:
        from_xy: ``(N, 2)`` pixels in the first image.
        to_xy: ``(N, 2)`` pixels in the second image, matched row by row.
    """
    try:
        _, mask = cv2.findFundamentalMat(
            from_xy,
            to_xy,
            cv2.USAC_MAGSAC,
            ransacReprojThreshold=_EPIPOLAR_PX,
            confidence=0.999,
            maxIters=2000,
        )
    except cv2.error:
        # OpenCV 5 refines an empty model, and raises, on some matches of images that moved by a few pixels.
        _, info = poselib.estimate_fundamental(from_xy, to_xy, {"max_epipolar_error": _EPIPOLAR_PX}, {})
        mask = np.asarray(info["inliers"], dtype=np.uint8)
    return mask.ravel().astype(bool) if mask is not None and mask.size == len(from_xy) else None


def _moves_like_its_neighbours(xy: Array, flow: Array, trusted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points move about like the median of the trusted points next to them; depth may differ much."""
    square = square_distances(xy, xy[trusted])
    nearest = np.argsort(square, axis=1, kind="stable")[:, :_NEIGHBOURS]
    around = np.median(flow[trusted][nearest], axis=1)
    allowed_px = _FREE_FLOW_PX + _FREE_FLOW_SHARE * np.linalg.norm(around, axis=1)
    return np.asarray(np.linalg.norm(flow - around, axis=1) < allowed_px)
