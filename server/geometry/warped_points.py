"""Points followed between two images that see what is around them turned, scaled or sheared.

Lucas-Kanade takes a window for moved and no more; of one that was turned by twenty degrees it finds something
like it nearby. Where matches around a point tell the warp, its window is warped before it is looked for.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.corners import corner_strength
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.klt import MAX_FORWARD_BACKWARD_PX, TrackedPoints, track_points
from semcast.server.geometry.patch_alignment import ANCHOR_PATCH_PX, Templates, align_patches
from semcast.server.geometry.sampling import sample_map

Array = NDArray[np.float64]

#: A point further from its guess than this is another one.
MAX_FROM_GUESS_PX = 25.0
#: So is one whose warped window looks less alike, by normalised correlation.
_MIN_CORRELATION = 0.7
#: Guesses are rough: the search takes more steps than one that begins within a pixel or two.
_ITERATIONS = 15
#: A window that is seen at less than this share of its area, or more than its inverse, has other details.
_MIN_AREA_RATIO = 0.25
#: Where a warp moves nothing in a window by more than this share of its offset, Lucas-Kanade holds.
_HARDLY_WARPED = 0.15
#: Mean size of a Gaussian value in standard deviations.
_MEAN_OF_SIGMA = float(np.sqrt(2.0 / np.pi))


def track_warped(grey0: Grey, grey1: Grey, xy0: Array, guess1_xy: Array, warps: Array) -> TrackedPoints:
    """Follow points whose windows are warped in a known way, there and back.

    Where the warp is small, Lucas-Kanade does: it looks further, and matches tell a warp to a tenth.

    Args:
        grey0: Image the points are known in.
        grey1: Image they are looked for in.
        xy0: ``(N, 2)`` pixels in ``grey0``.
        guess1_xy: ``(N, 2)`` where they are expected in ``grey1``.
        warps: ``(N, 2, 2)`` derivatives of pixels in ``grey1`` by those in ``grey0``.
    """
    moved = track_points(grey0, grey1, xy0, guess1_xy, max_level=1)
    rows = np.linalg.norm(warps - np.eye(2), ord=2, axis=(1, 2)) >= _HARDLY_WARPED
    found = moved
    if rows.any():
        found = moved.but_for(rows, _aligned(grey0, grey1, xy0[rows], guess1_xy[rows], warps[rows]))
    # Points that left the image were clipped to its border and found something else there.
    near = np.linalg.norm(found.xy - guess1_xy, axis=1) < MAX_FROM_GUESS_PX
    return replace(found, ok=found.ok & near)


def _aligned(grey0: Grey, grey1: Grey, xy0: Array, guess1_xy: Array, warps: Array) -> TrackedPoints:
    area = np.linalg.det(warps)
    sound = (area > _MIN_AREA_RATIO) & (area < 1.0 / _MIN_AREA_RATIO)
    warps = np.where(sound[:, None, None], warps, np.eye(2))
    before = Templates.cut(grey0, xy0, ANCHOR_PATCH_PX)
    there = align_patches(before, grey1, guess1_xy, warps, iterations=_ITERATIONS)
    after = Templates.cut(grey1, there.xy, ANCHOR_PATCH_PX)
    back = align_patches(after, grey0, xy0, np.asarray(np.linalg.inv(warps), np.float64))
    distance = np.linalg.norm(back.xy - xy0, axis=1)
    inside = ((there.xy >= 1) & (there.xy < np.array(grey1.shape[::-1]) - 2)).all(axis=1)
    alike = (there.correlation > _MIN_CORRELATION) & (distance < MAX_FORWARD_BACKWARD_PX)
    unexplained = np.maximum(1.0 - there.correlation**2, 0.0) * np.square(before.values).mean(axis=1)
    photometric = _MEAN_OF_SIGMA * np.sqrt(unexplained)
    gradient = sample_map(corner_strength(grey1), there.xy)
    return TrackedPoints(there.xy, sound & inside & alike, distance, photometric, gradient)
