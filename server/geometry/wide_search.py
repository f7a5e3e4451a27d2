"""Finds tracks again after a jump of the image that Lucas-Kanade can't follow: descriptors, then geometry.

A gap in the stream, a low frame rate or a jerk moves points further than a pyramid reaches. Tracks are then
described where they were last seen, corners of the new image are matched with them, and what agrees on one
epipolar geometry gives each track a place to start from.
"""

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from semcast.server.geometry.features import Describer, Grey, detect_corners, match_descriptors

Array = NDArray[np.float64]

#: Octaves of the new image, so that points that came nearer still match.
_OCTAVES = (0, 1, 2, 3)
_NUM_CORNERS = 800
_CELL_PX = 40
_EPIPOLAR_PX = 3.0
_NEIGHBOURS = 7
_FREE_FLOW_PX = 15.0
#: Matches that agree, at least; fewer prove nothing.
MIN_AGREEING = 15
#: Nor does a share of all matches below this.
_MIN_AGREEING_SHARE = 0.4


def search_wide(
    grey0: Grey, grey1: Grey, xy0: Array, usable: NDArray[np.bool_] | None = None
) -> Array | None:
    """Find where points of one image are in another, however far they moved.

    Args:
        grey0: Image the points are known in.
        grey1: Image they are looked for in.
        xy0: ``(N, 2)`` pixels in ``grey0``.
        usable: ``(H, W)`` bool, False where ``grey1`` shows nothing.

    Returns:
        ``(N, 2)`` places in ``grey1`` to start Lucas-Kanade from: of matched points where their match is, of
        the others where the matched point next to them would take them. None where too few matches agree.
    """
    describer = Describer()
    corners = detect_corners(grey1, _NUM_CORNERS, None, usable, _CELL_PX).astype(np.float64)
    rows0, known = describer.describe(grey0, xy0)
    rows1, seen = describer.describe(grey1, corners, _OCTAVES)
    of_seen, of_known = match_descriptors(seen, known)
    if len(of_seen) < MIN_AGREEING:
        return None
    point, corner = rows0[of_known], rows1[of_seen]
    from_xy, to_xy = xy0[point], corners[corner]
    agrees = epipolar_inliers(from_xy, to_xy)
    if agrees is None or int(agrees.sum()) < max(MIN_AGREEING, _MIN_AGREEING_SHARE * len(point)):
        return None
    # A wrong match may lie on its epipolar line by chance; it hardly moves like the matches around it.
    agrees &= _moves_like_its_neighbours(from_xy, to_xy - from_xy, agrees)
    if int(agrees.sum()) < MIN_AGREEING:
        return None
    point, from_xy, to_xy = point[agrees], from_xy[agrees], to_xy[agrees]
    square = ((xy0[:, None] - from_xy[None]) ** 2).sum(axis=2)
    nearest = square.argmin(axis=1)
    guess: Array = xy0 + (to_xy - from_xy)[nearest]
    guess[point] = to_xy
    return guess


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
    square = ((xy[:, None] - xy[None, trusted]) ** 2).sum(axis=2)
    nearest = np.argsort(square, axis=1, kind="stable")[:, :_NEIGHBOURS]
    around = np.median(flow[trusted][nearest], axis=1)
    allowed_px = _FREE_FLOW_PX + 0.5 * np.linalg.norm(around, axis=1)
    return np.asarray(np.linalg.norm(flow - around, axis=1) < allowed_px)
