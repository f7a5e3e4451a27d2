"""How much brighter one image is than another, seen at points they share.

Lucas-Kanade takes a difference in brightness for a shift. Cameras change their exposure, and a landmark of
long ago was seen in another light.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.sampling import nearest_pixels
from semcast.server.geometry.weighting import MAD_TO_SIGMA

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: Side of the patch a point's brightness is the mean of: a corner is dark on one side.
_PATCH_PX = 7
#: Patches outside these grey levels may be clipped.
_DARKEST = 8.0
_BRIGHTEST = 247.0
#: Points that tell a change at least.
MIN_POINTS = 20
#: Rounds of reweighting (Huber).
_ITERATIONS = 5
#: An exposure is a gain: an offset is taken to be no larger than about this, and matters for tone curves.
_OFFSET_SIGMA_GREY = 10.0
#: Gains beyond this, or its inverse, are those of points that were not found at all.
_MAX_GAIN = 4.0
#: A change that moves the typical point by less does not matter to Lucas-Kanade.
_MIN_CHANGE_GREY = 1.5
#: Nor does one count that is below this many standard errors of the fit: most points are not what they were.
_CHANCE_SIGMAS = 4.0


def brightness_change(
    grey0: Grey, grey1: Grey, xy0: Array, xy1: Array, patch_px: int = _PATCH_PX
) -> tuple[float, float] | None:
    """Fit ``grey1 = gain * grey0 + offset`` to patches around the same points, robustly.

    Args:
        grey0: First image.
        grey1: Second image.
        xy0: ``(N, 2)`` points in the first image.
        xy1: ``(N, 2)`` the same in the second image; some may be wrong.
        patch_px: Side of the patches, odd: the larger, the less it matters that all are wrong by a little.

    Returns:
        Gain and offset in grey levels; None where points are too few, or where the change is too small to
        matter or no larger than chance would have it.
    """
    before, after = _patch_means(grey0, xy0, patch_px), _patch_means(grey1, xy1, patch_px)
    inside = (np.minimum(before, after) > _DARKEST) & (np.maximum(before, after) < _BRIGHTEST)
    before, after = before[inside], after[inside]
    if len(before) < MIN_POINTS or abs(np.median(after - before)) < 0.5 * _MIN_CHANGE_GREY:
        return None
    design = np.stack([before, np.ones_like(before)], axis=1)
    model = np.array([np.median(after / before), 0.0])
    for _ in range(_ITERATIONS):
        residual = np.abs(after - design @ model)
        scale = MAD_TO_SIGMA * float(np.median(residual)) + 0.1
        weight = 1.0 / np.maximum(residual, scale) / scale
        normal = design.T @ (weight[:, None] * design)
        normal[1, 1] += _OFFSET_SIGMA_GREY**-2
        model = np.linalg.solve(normal, design.T @ (weight * after))
    gain, offset = float(model[0]), float(model[1])
    change = float(np.median(np.abs(design @ model - before)))
    by_chance = _CHANCE_SIGMAS * scale / np.sqrt(len(before))
    if not 1.0 / _MAX_GAIN < gain < _MAX_GAIN or change < max(_MIN_CHANGE_GREY, by_chance):
        return None
    return gain, offset


def with_brightness(grey: Grey, gain: float, offset: float) -> Grey:
    """Return the image as it would be with another exposure, clipped as a camera clips."""
    levels = np.clip(np.rint(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(grey, levels), dtype=np.uint8)


def _patch_means(grey: Grey, xy: Array, patch_px: int) -> Array:
    """Mean of what of the patch around each point lies in the image, by sums of a table."""
    height, width = grey.shape
    table, half = cv2.integral(grey), patch_px // 2
    nearest = nearest_pixels(xy, grey.shape)
    left, top = np.maximum(nearest - half, 0).T
    right, bottom = np.minimum(nearest + half + 1, (width, height)).T
    total = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
    return np.asarray(total / ((right - left) * (bottom - top)))
