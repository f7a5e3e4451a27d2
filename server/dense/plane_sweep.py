"""How well neighbouring views agree with a reference at each of many depths (Collins, CVPR 1996)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.view import View

Array = NDArray[np.float64]
Volume = NDArray[np.float32]

#: Side of the window that is compared.
WINDOW = 5
#: Cost where nothing is known: as of windows without anything in common.
UNKNOWN_COST = 1.0
#: No pixel has this value: what lies outside of a warped image.
_OUTSIDE = -1e4
#: Variance of what lies outside, which does not count: only to divide by.
_LEAST_NOISE = 1.0


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

    The noise of both images counts as a variance that nothing explains, so that windows whose texture does
    not stand out of it say little. Of a group the mean counts, and of the groups (those before and those
    after the reference) the better one: what is hidden on one side is mostly seen from the other.

    Args:
        reference: The view whose depth is sought.
        groups: Neighbours, those before and those after the reference; none of them empty.
        inverse_depths: ``(D,)`` inverse depths in the reference's camera frame, ascending.

    Returns:
        ``(H, W, D)`` in [0, 2], ``UNKNOWN_COST`` where no neighbour of any group sees the pixel.
    """
    height, width = reference.shape_hw
    ref = reference.grey
    mean_ref = _box(ref)
    var_ref = np.maximum(_box(ref * ref) - mean_ref * mean_ref, 0.0) + _box(reference.sigma**2)
    K_inv = np.linalg.inv(reference.K)
    cost = np.full((len(inverse_depths), height, width), np.inf, np.float32)
    for d, inverse_depth in enumerate(inverse_depths.tolist()):
        for group in groups:
            total = np.zeros((height, width), np.float32)
            weight = np.zeros((height, width), np.float32)
            for neighbour in group:
                H = _homography(neighbour, K_inv, inverse_depth)
                correlation, seen = _correlation(ref, mean_ref, var_ref, neighbour.view, H)
                total += correlation * seen
                weight += seen
            group_cost = 1.0 - total / np.maximum(weight, 1.0)
            np.minimum(cost[d], np.where(weight > 0.0, group_cost, np.inf), out=cost[d])
    cost[~np.isfinite(cost)] = UNKNOWN_COST
    return np.ascontiguousarray(cost.transpose(1, 2, 0))


def _homography(neighbour: Neighbour, K_inv: Array, inverse_depth: float) -> Array:
    """Reference pixels to the neighbour's, by a plane across the reference's optical axis."""
    R, t = neighbour.T_nbr_ref[:3, :3], neighbour.T_nbr_ref[:3, 3]
    plane = R.copy()
    plane[:, 2] += inverse_depth * t
    return np.asarray(neighbour.view.K @ plane @ K_inv)


def _correlation(
    ref: NDArray[np.float32],
    mean_ref: NDArray[np.float32],
    var_ref: NDArray[np.float32],
    view: View,
    H: Array,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normalised cross-correlation with a warped view, and where that is seen (0 or 1)."""
    warped = _warp(np.dstack([view.grey, view.sigma**2]), H, ref.shape)
    grey, noise = warped[..., 0], warped[..., 1]
    seen = grey >= 0.0
    grey, noise = np.where(seen, grey, mean_ref), np.where(seen, noise, _LEAST_NOISE)
    mean = _box(grey)
    var = np.maximum(_box(grey * grey) - mean * mean, 0.0) + np.maximum(_box(noise), _LEAST_NOISE)
    covariance = _box(grey * ref) - mean * mean_ref
    return covariance / np.sqrt(var_ref * var), seen.astype(np.float32)


def _warp(image: NDArray[np.float32], H: Array, shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.asarray(
        cv2.warpPerspective(
            image,
            H,
            (shape[1], shape[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(_OUTSIDE, 0.0, 0.0, 0.0),
        ),
        np.float32,
    )


def _box(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(
        cv2.boxFilter(values, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REPLICATE), np.float32
    )
