"""Anisotropic errors: how much better a point is known across an edge than along it.

The covariance of an aligned window is proportional to the inverse of its structure tensor. The noise model
(``weighting``) tells its size from the point's confidence; this module tells its shape. A point on the frame
of a door slides along it by a pixel or two, and is as well known across it as the best corner. With an
isotropic error it would count for little, or mislead.

An *edge* is a vector along the edge whose length ``a`` is half the logarithm of the ratio of the two
standard deviations: the covariance is ``sigma^2 (e^2a u u^T + e^-2a n n^T)``, of the same determinant
whatever the shape. The zero vector is an isotropic error.
"""

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Ratio of the standard deviations along and across an edge at most: nothing is known to less than a tenth of
#: a pixel, and edges that are bent are straight for a few pixels only.
_MOST_RATIO = 10.0
#: Half the side of the window whose gradients count.
_REACH_PX = 8
#: Distance of the gradients that are summed: they are smooth over as much.
_STEP_PX = 2
#: To what ``rounded`` rounds lengths,
_LENGTH_STEP = 0.2
#: and into how many parts half a turn: an edge lies the same way whichever end it points to.
_NUM_ANGLES = 36


def edges_at(grey: NDArray[np.uint8], xy: Array) -> Array:
    """Compute the edges ``(N, 2)`` at points ``(N, 2)`` of an ``(H, W)`` image; their sign has no meaning."""
    height, width = grey.shape
    if len(xy) == 0 or min(height, width) <= 2 * _REACH_PX:
        return np.zeros((len(xy), 2))
    side = 2 * _REACH_PX + 1
    left = np.clip(np.rint(xy[:, 0]).astype(np.intp) - _REACH_PX, 0, width - side)
    top = np.clip(np.rint(xy[:, 1]).astype(np.intp) - _REACH_PX, 0, height - side)
    gx, gy = (
        sliding_window_view(slope, (side, side))[:, :, ::_STEP_PX, ::_STEP_PX][top, left]
        .reshape(len(xy), -1)
        .astype(np.float32)
        for slope in cv2.spatialGradient(grey)
    )
    xx, xy_, yy = (np.einsum("nk,nk->n", a, b).astype(np.float64) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    half, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy_)
    weak, strong = np.maximum(half - spread, 0.0), half + spread
    ratio = np.minimum(np.sqrt((strong + 1e-9) / (weak + 1e-9)), _MOST_RATIO)
    across = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    along = np.column_stack([-np.sin(across), np.cos(across)])
    return np.asarray(0.5 * np.log(ratio)[:, None] * along)


def whiteners(edge: Array) -> Array:
    """Whitening matrices ``(N, 2, 2)`` of points with edges ``(N, 2)``: they make errors isotropic.

    They are symmetric and of determinant 1, so whitened errors have the noise model's sigma.
    """
    length = np.linalg.norm(edge, axis=1)
    along = edge / np.maximum(length, 1e-12)[:, None]
    turned = np.eye(2) - 2.0 * along[:, :, None] * along[:, None, :]
    return np.asarray(np.cosh(length)[:, None, None] * np.eye(2) + np.sinh(length)[:, None, None] * turned)


def whitened(edge: Array, error_px: Array) -> Array:
    """Whiten errors ``(N, 2)`` at points with edges ``(N, 2)``."""
    return np.asarray((whiteners(edge) @ error_px[..., None])[..., 0])


def rounded(edge: Array) -> Array:
    """Round edges ``(N, 2)`` to a few lengths and directions, so that many are equal."""
    length = np.rint(np.linalg.norm(edge, axis=1) / _LENGTH_STEP) * _LENGTH_STEP
    step = np.pi / _NUM_ANGLES
    angle = np.rint(np.arctan2(edge[:, 1], edge[:, 0]) / step) % _NUM_ANGLES * step
    return np.asarray(length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def alike() -> Array:
    """Return the edge ``(1, 2)`` that stands for any number of points with isotropic errors."""
    return np.zeros((1, 2))


def each_of(edge: Array, count: int) -> Array:
    """Return the edges ``(count, 2)`` of points, ``alike`` repeated for each of them."""
    return edge if len(edge) == count else np.broadcast_to(edge, (count, 2))
