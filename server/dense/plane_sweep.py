"""How well neighbouring views agree with a reference at each of many depths (Collins, CVPR 1996)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.view import View

Array = NDArray[np.float64]
Volume = NDArray[np.uint8]
Image = NDArray[np.float32]

#: Side of the window that is compared, in pixels,
WINDOW = 5
#: and where the reference is noisy: noise asks for more pixels, which blur the outlines of things.
WINDOW_OF_NOISY = 7
#: Median noise of the reference, in grey levels, from which on it is noisy.
_NOISY_LEVELS = 3.75
#: Cost of windows that have nothing in common, and of what no neighbour sees; no cost is larger.
UNKNOWN_COST = 100
#: Contrast of a window, grey levels, that half of its correlation is left of: below it there is noise.
_FAINT_LEVELS = 1.0
#: Correlation that windows of noise have now and then: below it there is nothing in common. Otherwise depths
#: at which more neighbours see a pixel would cost less, having more chances.
_CHANCE = 0.2
#: Side of a window's middle.
_MIDDLE = 3
#: Share of the window's variance in its middle from which on the window counts fully: one on plain ground
#: that reaches a thing's outline is alike at the thing's depth, where the ground is not.
_ENOUGH = 0.5
#: No pixel has this value, nor one near it: what lies beside a warped image.
_BESIDE = -1e4
_WHITE = 255.0


@dataclass(frozen=True)
class Neighbour:
    """Another view of the same place.

    Attributes:
        view: Its image.
        T_nbr_ref: ``(4, 4)`` from the reference's camera frame to its own.
    """

    view: View
    T_nbr_ref: Array


def match_cost(reference: View, groups: Sequence[Sequence[Neighbour]], inverse_depths: Array) -> Volume:
    """Cost of each depth at each pixel: one less the normalised cross-correlation of windows.

    Where little of a window's variance is in its middle it counts for little: pixels around decide there.

    Of a group the mean counts, and of the groups (those before and those after the reference) the better one:
    what is hidden on one side is mostly seen from the other.

    Args:
        reference: The view whose depth is sought.
        groups: Neighbours, those before and those after the reference; none of them empty.
        inverse_depths: ``(D,)`` inverse depths in the reference's camera frame, ascending.

    Returns:
        ``(D, H, W)`` of 0 for alike to ``UNKNOWN_COST`` for nothing in common or not seen by any neighbour.
    """
    ref = _Reference(reference)
    centred = [[(n, _centred(n.view)) for n in group] for group in groups]
    K_inv = np.linalg.inv(reference.K).astype(np.float64)
    per_correlation = UNKNOWN_COST / (1.0 - _CHANCE) * ref.own_share()
    cost = np.empty((len(inverse_depths), *reference.shape_hw), np.uint8)
    for d, inverse_depth in enumerate(inverse_depths.tolist()):
        best = np.zeros(reference.shape_hw, np.float32)
        for group in centred:
            total, weight = np.zeros_like(best), np.zeros_like(best)
            for neighbour, grey in group:
                correlation, seen = ref.correlation(grey, _homography(neighbour, K_inv, inverse_depth))
                total += correlation
                weight += seen
            total /= np.maximum(weight, 1e-6)
            np.maximum(best, total, out=best)
        cost[d] = np.rint(UNKNOWN_COST - per_correlation * (np.clip(best, _CHANCE, 1.0) - _CHANCE))
    return cost


class _Reference:
    """What correlations of a reference with other views have in common."""

    def __init__(self, view: View) -> None:
        self._grey = _centred(view)
        self._window = WINDOW_OF_NOISY if view.noise > _NOISY_LEVELS else WINDOW
        self._mean = self._box(self._grey)
        self._per_sd = 1.0 / np.sqrt(self._variance(self._window) + _FAINT_LEVELS**2)

    def own_share(self) -> Image:
        """Return how far windows count, 0 to 1: by what of their variance is in their middle."""
        share = self._variance(_MIDDLE) * self._per_sd**2
        return np.asarray(np.minimum(share / np.float32(_ENOUGH), 1.0), np.float32)

    def correlation(self, other: Image, H: Array) -> tuple[Image, NDArray[np.bool_]]:
        """Return the normalised cross-correlation with an image warped by ``H``, and where that is seen."""
        height, width = self._grey.shape
        how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        grey = np.asarray(
            cv2.warpPerspective(
                other, H, (width, height), flags=how, borderMode=cv2.BORDER_CONSTANT, borderValue=_BESIDE
            ),
            np.float32,
        )
        seen = grey > -_WHITE
        corners = np.array([[x, y, 1.0] for x in (0, width - 1) for y in (0, height - 1)])
        if (corners @ H[2] <= 0.0).any():  # what is behind the other camera has a place in its image, too
            x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
            seen &= np.float32(H[2, 0]) * x + np.float32(H[2, 1]) * y + np.float32(H[2, 2]) > 0.0
        grey *= seen
        mean = self._box(grey)
        variance = self._box(grey * grey)
        variance -= mean * mean
        np.maximum(variance, 0.0, out=variance)
        variance += _FAINT_LEVELS**2
        grey *= self._grey
        correlation = self._box(grey)
        mean *= self._mean
        correlation -= mean
        correlation *= self._per_sd
        correlation /= np.sqrt(variance, out=variance)
        correlation *= seen
        return correlation, seen

    def _variance(self, window: int) -> Image:
        mean = _box(self._grey, window)
        return np.maximum(_box(self._grey * self._grey, window) - mean * mean, 0.0)

    def _box(self, values: Image) -> Image:
        return _box(values, self._window)


def _box(values: Image, side: int) -> Image:
    return np.asarray(cv2.boxFilter(values, -1, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)


def _centred(view: View) -> Image:
    """Return grey levels about 0, whose squares lose less of float32."""
    return view.grey - np.float32(0.5 * _WHITE)


def _homography(neighbour: Neighbour, K_inv: Array, inverse_depth: float) -> Array:
    """Reference pixels to the neighbour's, by a plane across the reference's optical axis."""
    R, t = neighbour.T_nbr_ref[:3, :3], neighbour.T_nbr_ref[:3, 3]
    plane = R.copy()
    plane[:, 2] += inverse_depth * t
    return np.asarray(neighbour.view.K @ plane @ K_inv)
