"""Which depths other keyframes confirm, and which of their points are the same."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.depth_map import DepthImage

Array = NDArray[np.float64]

#: Two depths agree within so many steps of the coarser of both, or this share.
_STEPS = 1.5
_SHARE = 0.02


@dataclass(frozen=True)
class OtherDepth:
    """Another keyframe's depth.

    Attributes:
        inverse_depth: ``(H, W)``, NaN where it is not known, in the units of the depths that are checked.
        step: What it is good to.
        K: ``(3, 3)`` of its pixels.
        T_other_ref: ``(4, 4)`` from the camera frame of the depths that are checked to its own.
    """

    inverse_depth: DepthImage
    step: float
    K: Array
    T_other_ref: Array


def back_project(inverse_depth: DepthImage, K: Array) -> Array:
    """Points ``(H, W, 3)`` in the camera frame; NaN where the depth is not known."""
    height, width = inverse_depth.shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones((height, width))], axis=-1)
    return np.asarray(rays / inverse_depth[..., None].astype(np.float64))


def num_agreeing(
    inverse_depth: DepthImage, step: float, K: Array, others: Sequence[OtherDepth]
) -> NDArray[np.intp]:
    """Count for each pixel how many other keyframes see the same surface there.

    Args:
        inverse_depth: ``(H, W)``, NaN where it is not known.
        step: What it is good to.
        K: ``(3, 3)`` of its pixels.
        others: Depths of other keyframes.

    Returns:
        ``(H, W)`` counts, 0 where the depth is not known.
    """
    count = np.zeros(inverse_depth.shape, np.intp)
    known = np.isfinite(inverse_depth)
    points = back_project(inverse_depth, K)[known]
    for other in others:
        count[known] += agrees(points, step, other)
    return count


def agrees(points: Array, step: float, other: OtherDepth) -> NDArray[np.bool_]:
    """Tell which points lie on what another keyframe sees.

    Args:
        points: ``(N, 3)`` in the camera frame of ``other.T_other_ref``.
        step: What their inverse depth is good to.
        other: The depth of the other keyframe.
    """
    T = other.T_other_ref
    moved = points @ T[:3, :3].T + T[:3, 3]
    height, width = other.inverse_depth.shape
    z = moved[:, 2]
    ahead = z > 0.0
    pixel = np.full((len(points), 2), -1, np.intp)
    projected = moved[ahead] @ other.K.T
    xy = projected[:, :2] / projected[:, 2:]
    near = (np.abs(xy) < 1e6).all(axis=1)
    pixel[np.flatnonzero(ahead)[near]] = np.rint(xy[near]).astype(np.intp)
    inside = ((pixel >= 0) & (pixel < [width, height])).all(axis=1)
    there = np.full(len(points), np.nan)
    there[inside] = other.inverse_depth[pixel[inside, 1], pixel[inside, 0]]
    within = np.maximum(_STEPS * max(step, other.step), _SHARE / np.where(ahead, z, 1.0))
    with np.errstate(invalid="ignore"):
        return np.asarray(inside & (np.abs(there - 1.0 / np.where(ahead, z, 1.0)) < within))
