"""A rolling shutter's readout time, from the residuals of adjustments.

A row that is read ``t`` seconds after the middle one is seen from a pose further on: its points are off by
``t`` times their flow.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import MAX_READOUT_MS, Intrinsics, ReadoutFrom
from semcast.common.geometry import log_so3
from semcast.server.geometry.finite_differences import slope_weights
from semcast.server.geometry.projection import projection_jacobian
from semcast.server.mapping.residual_patterns import (
    COLUMNS,
    PUT_RIGHT,
    RESIDUAL,
    ROWS,
    by_poses,
    grouped,
    shares_of_readout,
    spread,
)

Array = NDArray[np.float64]
#: Rows are read from top or bottom, columns (of an upright phone) from left or right.
Axis = Literal["rows", "columns"]

SIDES: dict[Axis, tuple[ReadoutFrom, ReadoutFrom]] = {
    "rows": ("top", "bottom"),
    "columns": ("left", "right"),
}
AXES: tuple[Axis, Axis] = ("rows", "columns")


@dataclass(frozen=True, order=True)
class Readout:
    """A readout time with its direction.

    Attributes:
        axis: What is read one after the other.
        signed_ms: From the first to the last; below 0 from the last to the first.
    """

    axis: Axis
    signed_ms: float

    @property
    def ms(self) -> float:
        """Time from the first row or column that is read to the last."""
        return abs(self.signed_ms)

    @property
    def side(self) -> ReadoutFrom:
        """Where it begins."""
        return SIDES[self.axis][self.signed_ms < 0]

    @staticmethod
    def of(camera: Intrinsics) -> "Readout":
        """Return that of a camera."""
        axis: Axis = "rows" if camera.readout_from in SIDES["rows"] else "columns"
        return Readout(axis, camera.readout_ms * (-1 if camera.readout_from == SIDES[axis][1] else 1))

    def put_on(self, camera: Intrinsics) -> Intrinsics:
        """Return a camera with this readout."""
        return replace(camera, readout_ms=min(self.ms, MAX_READOUT_MS), readout_from=self.side)

    def with_more(self, more: "Readout") -> "Readout":
        """Return the readout that is longer by another one, whose axis counts."""
        return Readout(more.axis, self.signed_ms * (self.axis == more.axis) + more.signed_ms)

    def __str__(self) -> str:
        return f"{self.ms:.1f} ms from {self.side}"


@dataclass(frozen=True)
class ReadoutFit:
    """The readout time that residuals speak for.

    Attributes:
        readout: Along the axis that explains more.
        sigma_ms: Standard deviation, by leaving out a part of the keyframes at a time.
        explained: Share of the squared residuals that it explains, without what images were put right for.
        unit_ms: The readout that would double the squared residuals.
    """

    readout: Readout
    sigma_ms: float
    explained: float
    unit_ms: float


def body_velocity(T_world_cam: Array, T_world_around: Array, since_s: Array) -> Array:
    """Return the velocity of a camera, see ``ViewMotion``, by its poses around a moment: ``(6,)``.

    Args:
        T_world_cam: ``(4, 4)`` at that moment; in its frame the velocity is given.
        T_world_around: ``(N, 4, 4)`` before and after.
        since_s: ``(N,)`` from that moment to these, all different and none 0.
    """
    R_cam_world = T_world_cam[:3, :3].T
    turned_rad = np.array([log_so3(R_cam_world @ T[:3, :3]) for T in T_world_around])
    moved_map = (T_world_around[:, :3, 3] - T_world_cam[:3, 3]) @ R_cam_world.T
    weights = slope_weights(np.append(since_s, 0.0))[:-1]
    return np.asarray(weights @ np.column_stack([turned_rad, moved_map]))


def lean(camera: Intrinsics, points_cam: Array, flow_px_s: Array) -> Array:
    """Return by how much the pose of a rolling shutter's image is off its middle row's, ``(6,)`` a twist.

    That is what a pose takes over of what the readout does to points, by least squares.

    Args:
        camera: Pinhole, with the readout.
        points_cam: ``(M, 3)`` seen, in its frame.
        flow_px_s: ``(M, 2)`` how they move in the image, pixels per second.
    """
    readout = Readout.of(camera)
    by_pose = by_poses(projection_jacobian(camera, points_cam), points_cam)
    share = shares_of_readout((camera.width, camera.height), camera.project(points_cam))
    moved_px = 1e-3 * readout.signed_ms * share[:, [AXES.index(readout.axis) ^ 1]] * flow_px_s
    return np.asarray(np.linalg.lstsq(by_pose.reshape(-1, 6), moved_px.ravel(), rcond=None)[0])


def fit_readout(views: Sequence[Array] | Array, axis: Axis | None = None) -> ReadoutFit | None:
    """Return the readout time that views speak for, None where they say nothing.

    It is all of it where ``ViewMotion`` tells how far points moved as images were put right: flows by which
    that was done may be wrong, as far as poses tell better. Else it is what is left of it.

    Args:
        views: ``(9, 9)`` of each, as ``residual_patterns.pattern_products_of`` gives them.
        axis: What is read one after the other, None for what explains more.
    """
    parts = grouped(views)
    if parts is None:
        return None
    total = parts.sum(axis=0)
    fits = []
    for name, k in zip(AXES, (ROWS, COLUMNS), strict=True):
        if axis in (None, name) and total[k, k] > 0.0:
            without = total - parts
            slopes = _speaks_for(without, k) / np.maximum(without[:, k, k], 1e-12)
            readout = Readout(name, float(1e3 * _speaks_for(total, k) / total[k, k]))
            explained = total[RESIDUAL, k] ** 2 / (total[k, k] * total[RESIDUAL, RESIDUAL])
            unit_ms = 1e3 * np.sqrt(total[RESIDUAL, RESIDUAL] / total[k, k])
            fits.append(ReadoutFit(readout, float(1e3 * spread(slopes)), float(explained), float(unit_ms)))
    return max(fits, key=lambda fit: fit.explained, default=None)


def _speaks_for(products: Array, pattern: int) -> Array:
    """Return the inner products ``(...)`` of a pattern and what a readout has done to points."""
    return np.asarray(products[..., RESIDUAL, pattern] + products[..., PUT_RIGHT, pattern])
