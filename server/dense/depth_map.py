"""Depth of every pixel of a keyframe from its neighbours, as far as the images tell it."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.plane_sweep import UNKNOWN_COST, Neighbour, match_cost
from semcast.server.dense.semi_global import NUM_DIRECTIONS, Smoothed, aggregate
from semcast.server.dense.view import View

Array = NDArray[np.float64]
DepthImage = NDArray[np.float32]

#: Depths that are tried: as many as the image moves by pixels between nearest and farthest, within these.
MIN_DEPTHS, MAX_DEPTHS = 24, 64
#: The second best match has to cost this share of the greatest cost more, the mean of all directions.
_MIN_LEAD = 0.11
#: Depths up to this many steps away belong to the same match.
_BESIDE = 2
#: Patches of fewer pixels are chance; pixels side by side are of one patch where their depths are at most so
#: many steps apart.
_MIN_PATCH_PX = 40
_MAX_APART = 1.5
#: Parts of a step that patches are told apart by.
_PARTS = 16
#: How many depths are tried follows the movement that so many percent of the pixels stay below,
_MOST_PERCENT = 90.0
#: looked at in one row and column of so many.
_GRID_PX = 8


@dataclass(frozen=True)
class DepthProblem:
    """What a depth map is made from.

    Attributes:
        reference: Whose depth is sought.
        groups: Neighbours: those before and those after it, none of the groups empty.
        nearest: Least depth that is tried, map units.
        farthest: Greatest depth that is tried.
    """

    reference: View
    groups: Sequence[Sequence[Neighbour]]
    nearest: float
    farthest: float

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: There is nothing to compare with, or depths are out of order.
        """
        if not self.groups or not all(self.groups):
            raise ValueError("groups must hold neighbours, got an empty one")
        if not 0.0 < self.nearest < self.farthest < np.inf:
            raise ValueError(
                "nearest and farthest must be 0 < nearest < farthest, "
                f"got {self.nearest:g}, {self.farthest:g}"
            )


@dataclass(frozen=True)
class DepthMap:
    """Depth of one keyframe.

    Attributes:
        frame_id: Of the keyframe.
        inverse_depth: ``(H, W)`` float32 per map unit, NaN where it is not known.
        step: Distance of two depths that were tried, per map unit: what it is good to, about.
    """

    frame_id: int
    inverse_depth: DepthImage
    step: float


def estimate_depth(problem: DepthProblem) -> DepthMap:
    """Estimate the depth of a keyframe's pixels.

    Depths are tried at equal steps of their inverse; the best one after smoothing counts, refined between the
    steps, where it is clearly better than any other.
    """
    reference = problem.reference
    inverse_depths = np.linspace(1.0 / problem.farthest, 1.0 / problem.nearest, _num_depths(problem))
    smoothed = aggregate(
        match_cost(reference, problem.groups, inverse_depths), reference.grey.astype(np.float32)
    )
    best = smoothed.argmin(axis=-1)
    step = float(inverse_depths[1] - inverse_depths[0])
    steps = _refined(smoothed, best)
    # The nearest and the farthest depth also stand for all that is beyond.
    known = (best > 0) & (best < len(inverse_depths) - 1)
    known &= _lead(smoothed, best) > _MIN_LEAD * UNKNOWN_COST * NUM_DIRECTIONS
    steps[~_without_specks(steps, known)] = np.nan
    inverse_depth = np.asarray(inverse_depths[0] + step * steps, np.float32)
    return DepthMap(reference.frame_id, inverse_depth, step)


def _without_specks(steps: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what is known but for small patches; ``(H, W)`` each, depths in steps."""
    parts = np.where(known, _PARTS * steps, -1).astype(np.int16)
    cv2.filterSpeckles(parts, -1, _MIN_PATCH_PX, _PARTS * _MAX_APART)
    return np.asarray(parts >= 0)


def _num_depths(problem: DepthProblem) -> int:
    """As many depths as the image moves by pixels between the nearest and the farthest."""
    height, width = problem.reference.shape_hw
    x, y = np.meshgrid(np.arange(0, width, _GRID_PX), np.arange(0, height, _GRID_PX))
    rays = np.linalg.inv(problem.reference.K).astype(np.float64) @ np.stack(
        [x.ravel(), y.ravel(), np.ones(x.size)]
    )
    moved = 0.0
    for neighbour in (n for group in problem.groups for n in group):
        near = _projected(neighbour, rays * problem.nearest)
        far = _projected(neighbour, rays * problem.farthest)
        inside = ((near >= 0.0) & (near < np.array([[width], [height]]))).all(axis=0)
        distance = np.linalg.norm(near - far, axis=0)[inside]
        if len(distance):
            moved = max(moved, float(np.percentile(distance, _MOST_PERCENT)))
    return int(np.clip(np.ceil(moved), MIN_DEPTHS, MAX_DEPTHS))


def _projected(neighbour: Neighbour, points: Array) -> Array:
    """Pixels ``(2, N)`` of points ``(3, N)`` of the reference's frame; far outside where they are behind."""
    T = neighbour.T_nbr_ref
    p = neighbour.view.K @ (T[:3, :3] @ points + T[:3, 3:])
    return np.asarray(np.where(p[2] > 0.0, p[:2] / np.where(p[2] > 0.0, p[2], 1.0), -1e9))


def _at(smoothed: Smoothed, idx: NDArray[np.intp]) -> NDArray[np.float32]:
    return np.asarray(np.take_along_axis(smoothed, idx[..., None], axis=-1)[..., 0], np.float32)


def _lead(smoothed: Smoothed, best: NDArray[np.intp]) -> NDArray[np.float32]:
    """By how much the best match is cheaper than any other; writes over the costs of the best one."""
    cost = _at(smoothed, best)
    for k in range(-_BESIDE, _BESIDE + 1):
        beside = np.clip(best + k, 0, smoothed.shape[-1] - 1)
        np.put_along_axis(smoothed, beside[..., None], np.iinfo(np.uint16).max, axis=-1)
    return np.asarray(smoothed.min(axis=-1) - cost)


def _refined(smoothed: Smoothed, best: NDArray[np.intp]) -> NDArray[np.float32]:
    """Where between the depths the cost is least, in steps: where two lines as steep on both sides meet.

    Smoothed costs rise by the step, not by its square: a parabola would draw depths to those that were tried.
    """
    middle = np.clip(best, 1, smoothed.shape[-1] - 2)
    before, at, after = (_at(smoothed, middle + k) for k in (-1, 0, 1))
    slope = np.maximum(np.maximum(before, after) - at, 1e-6)
    return np.asarray(middle + np.clip(0.5 * (before - after) / slope, -0.5, 0.5), np.float32)
