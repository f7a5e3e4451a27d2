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
from semcast.server.mapping.residual_patterns import (
    COLUMNS,
    RESIDUAL,
    ROWS,
    by_points,
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
        explained: Share of the squared residuals that it explains.
    """

    readout: Readout
    sigma_ms: float
    explained: float


def body_velocity(T_world_before: Array, T_world_cam: Array, T_world_after: Array, step_s: float) -> Array:
    """Return the velocity of a camera between two poses, see ``ViewMotion``: ``(6,)``.

    Args:
        T_world_before: ``(4, 4)`` a moment before.
        T_world_cam: ``(4, 4)`` in whose frame the velocity is given.
        T_world_after: ``(4, 4)`` a moment after.
        step_s: From before to after.
    """
    turned_rad = log_so3(T_world_before[:3, :3].T @ T_world_after[:3, :3])
    moved_map = T_world_cam[:3, :3].T @ (T_world_after[:3, 3] - T_world_before[:3, 3])
    return np.concatenate([turned_rad, moved_map]) / step_s


def lean(camera: Intrinsics, points_cam: Array, flow_px_s: Array) -> Array:
    """Return by how much the pose of a rolling shutter's image is off its middle row's, ``(6,)`` a twist.

    That is what a pose takes over of what the readout does to points, by least squares.

    Args:
        camera: Pinhole, with the readout.
        points_cam: ``(M, 3)`` seen, in its frame.
        flow_px_s: ``(M, 2)`` how they move in the image, pixels per second.
    """
    readout = Readout.of(camera)
    by_pose = by_poses(by_points(camera, points_cam), points_cam)
    share = shares_of_readout((camera.width, camera.height), camera.project(points_cam))
    moved_px = 1e-3 * readout.signed_ms * share[:, [AXES.index(readout.axis) ^ 1]] * flow_px_s
    return np.asarray(np.linalg.lstsq(by_pose.reshape(-1, 6), moved_px.ravel(), rcond=None)[0])


def fit_readout(views: Sequence[Array] | Array, axis: Axis | None = None) -> ReadoutFit | None:
    """Return the readout time that views speak for, None where they say nothing.

    Args:
        views: ``(8, 8)`` of each, as ``residual_patterns.pattern_products_of`` gives them.
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
            slopes = without[:, RESIDUAL, k] / np.maximum(without[:, k, k], 1e-12)
            readout = Readout(name, float(1e3 * total[RESIDUAL, k] / total[k, k]))
            explained = total[RESIDUAL, k] ** 2 / (total[k, k] * total[RESIDUAL, RESIDUAL])
            fits.append(ReadoutFit(readout, float(1e3 * spread(slopes)), float(explained)))
    return max(fits, key=lambda fit: fit.explained, default=None)
