"""Which depths other keyframes confirm, and which of their points are the same."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.depth_map import DepthImage, DepthMap
from semcast.server.dense.neighbours import num_to_confirm

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


def confirmed_depth(
    inverse_depth: DepthImage, step: float, K: Array, others: Sequence[OtherDepth], num_needed: int
) -> DepthImage:
    """Keep what other keyframes see too, as the mean of all that agree, each weighted by its own step.

    Args:
        inverse_depth: ``(H, W)``, NaN where it is not known.
        step: What it is good to.
        K: ``(3, 3)`` of its pixels.
        others: Depths of other keyframes.
        num_needed: So many of them have to agree.

    Returns:
        ``(H, W)`` inverse depths, NaN where they are not confirmed.
    """
    known = np.isfinite(inverse_depth)
    points = back_project(inverse_depth, K)[known]
    count = np.zeros(len(points), np.intp)
    # By what a point comes nearer along its ray, in the mean: as the other camera sees it, near enough.
    total, weight = np.zeros(len(points), np.float32), np.ones(len(points), np.float32)
    for other in others:
        off = _off(points, step, other)
        agrees_here = np.isfinite(off)
        count += agrees_here
        share = np.float32((step / other.step) ** 2)
        total += share * np.where(agrees_here, off, 0.0)
        weight += share * agrees_here
    confirmed = np.full_like(inverse_depth, np.nan)
    confirmed[known] = np.where(
        count >= num_needed, inverse_depth[known] * (1.0 + total / weight), np.float32(np.nan)
    )
    return confirmed


def confirmed_by(found: DepthMap, K: Array, others: Sequence[OtherDepth]) -> DepthMap:
    """Keep of a depth map what enough of the others see too, see ``confirmed_depth``."""
    needed = num_to_confirm(len(others))
    return replace(found, inverse_depth=confirmed_depth(found.inverse_depth, found.step, K, others, needed))


def added_points(
    confirmed: DepthMap, K: Array, covering: Sequence[OtherDepth]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return what a keyframe adds to the cloud of those before it.

    Args:
        confirmed: Its depth.
        K: ``(3, 3)`` of its pixels.
        covering: Confirmed depth of keyframes before.

    Returns:
        Points ``(N, 3)`` in the camera frame, and their pixels ``(H, W)`` bool, row by row.
    """
    pixels = np.isfinite(confirmed.inverse_depth)
    points = back_project(confirmed.inverse_depth, K)[pixels]
    new = not_yet_seen(points, confirmed.step, covering)
    pixels[pixels] = new
    return points[new], pixels


def not_yet_seen(
    points: NDArray[np.floating], step: float, others: Sequence[OtherDepth]
) -> NDArray[np.bool_]:
    """Tell which points lie on no surface of the others: what they added is not added once more.

    Args:
        points: ``(N, 3)`` in the camera frame of the others' ``T_other_ref``.
        step: What their inverse depth is good to.
        others: Confirmed depth of keyframes before.
    """
    seen = np.zeros(len(points), bool)
    for other in others:
        seen |= np.isfinite(_off(points, step, other))
    return ~seen


def _off(points: NDArray[np.floating], step: float, other: OtherDepth) -> NDArray[np.float32]:
    """By what share another keyframe sees points ``(N, 3)`` nearer; NaN where it sees something else."""
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
    nearer = other.inverse_depth.ravel()[at] - per_z
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(inside & (np.abs(nearer) < within), nearer / per_z, np.nan), np.float32)
