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


def back_project(inverse_depth: DepthImage, K: Array) -> NDArray[np.float32]:
    """Points ``(H, W, 3)`` in the camera frame; NaN where the depth is not known."""
    height, width = inverse_depth.shape
    z = 1.0 / inverse_depth
    x = (np.arange(width, dtype=np.float32) - np.float32(K[0, 2])) / np.float32(K[0, 0])
    y = (np.arange(height, dtype=np.float32) - np.float32(K[1, 2])) / np.float32(K[1, 1])
    return np.stack([x * z, y[:, None] * z, z], axis=-1)


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
    count[known] = sum((agrees(points, step, other) for other in others), np.zeros(len(points), np.intp))
    return count


def agrees(points: NDArray[np.floating], step: float, other: OtherDepth) -> NDArray[np.bool_]:
    """Tell which points lie on what another keyframe sees.

    Args:
        points: ``(N, 3)`` in the camera frame of ``other.T_other_ref``.
        step: What their inverse depth is good to.
        other: The depth of the other keyframe.
    """
    height, width = other.inverse_depth.shape
    T = other.T_other_ref
    A, b = (other.K @ T[:3, :3]).astype(np.float32), (other.K @ T[:3, 3]).astype(np.float32)
    x, y, z = A @ np.asarray(points, np.float32).T + b[:, None]
    ahead = z > 0.0
    per_z = 1.0 / np.where(ahead, z, 1.0)
    column, row = np.rint(x * per_z), np.rint(y * per_z)
    inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(inside, row * width + column, 0.0).astype(np.intp)
    within = np.maximum(_STEPS * max(step, other.step), _SHARE * per_z)
    with np.errstate(invalid="ignore"):
        return np.asarray(inside & (np.abs(other.inverse_depth.ravel()[at] - per_z) < within))
