"""Alignment of patches between two images that may see them turned and at another scale.

Inverse compositional Lucas-Kanade (Baker and Matthews 2004) with a known affine warp: only the position is
searched for, so that the template's derivatives are computed once. All patches are worked on together.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.features import Grey

Array = NDArray[np.float64]
Values = NDArray[np.float32]

#: Range of the contrast of one patch against the other.
_GAIN_RANGE = (0.5, 2.0)
#: Steps shorter than this end the search.
_SMALL_STEP_PX = 0.02
#: A structure tensor whose determinant is smaller than this share of its squared trace is an edge.
_MIN_CORNERNESS = 1e-6


@dataclass(frozen=True)
class AlignedPatches:
    """Where patches of one image are in another.

    Attributes:
        xy: ``(N, 2)`` pixels in the second image.
        correlation: ``(N,)`` in [-1, 1], zero-mean normalised cross-correlation there; -1 where the patch has
            too little structure or the search left the numbers.
    """

    xy: Array
    correlation: Array


def affine_warps(
    camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, depth0_map: Array
) -> tuple[Array, Array]:
    """Local warps of small planes that face the first camera.

    Args:
        camera: Pinhole of both images.
        T_cam1_cam0: ``(4, 4)`` from the first camera to the second.
        xy0: ``(N, 2)`` pixels in the first image.
        depth0_map: ``(N,)`` positive depth of each along the first camera's axis, map units.

    Returns:
        ``(N, 2, 2)`` derivatives of pixels in the second image by those in the first, and ``(N,)`` depths in
        the second camera; where those are not positive the warp is the identity.
    """
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    x, y, depth1 = (camera.unproject(xy0) * depth0_map[:, None] @ R.T + t).T
    front = depth1 > 0.0
    z = np.where(front, depth1, 1.0)
    projection = np.zeros((len(xy0), 2, 3))
    projection[:, 0, 0], projection[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    projection[:, 1, 1], projection[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    in_plane = R[:, :2] / np.array([camera.fx, camera.fy])
    warps = projection @ in_plane * depth0_map[:, None, None]
    return np.where(front[:, None, None], warps, np.eye(2)), depth1


def align_patches(
    image0: Grey,
    image1: Grey,
    xy0: Array,
    start1_xy: Array,
    warps: Array,
    *,
    window_px: int = KLT_WINDOW_PX,
    iterations: int = 6,
) -> AlignedPatches:
    """Find where the patches around points of one image are in another.

    Brightness and contrast of each patch may differ.

    Args:
        image0: Image of the templates.
        image1: Image they are looked for in.
        xy0: ``(N, 2)`` centres in ``image0``.
        start1_xy: ``(N, 2)`` starts in ``image1``, right to about two pixels.
        warps: ``(N, 2, 2)`` derivatives of pixels in ``image1`` by those in ``image0``.
        window_px: Side of the patch in ``image0``, odd.
        iterations: Steps at most.
    """
    count = len(xy0)
    if count == 0:
        return AlignedPatches(np.zeros((0, 2)), np.zeros(0))
    offset = np.arange(-(window_px // 2) - 1, window_px // 2 + 2)
    dy, dx = (d.ravel() for d in np.meshgrid(offset, offset, indexing="ij"))
    wide = _sample(image0, xy0[:, :1] + dx, xy0[:, 1:] + dy).reshape(count, len(offset), len(offset))
    template = _centred(wide[:, 1:-1, 1:-1].reshape(count, -1))
    slope_x = _centred((0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2])).reshape(count, -1))
    slope_y = _centred((0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1])).reshape(count, -1))
    a, b, c = (_products(*pair) for pair in ((slope_x, slope_x), (slope_x, slope_y), (slope_y, slope_y)))
    determinant = a * c - b * b
    usable = determinant > _MIN_CORNERNESS * (a + c) ** 2
    determinant = np.where(usable, determinant, 1.0)
    dy, dx = (d.ravel() for d in np.meshgrid(offset[1:-1], offset[1:-1], indexing="ij"))
    across = warps[:, :, :1] * dx + warps[:, :, 1:] * dy  # (N, 2, window^2)
    xy, correlation = start1_xy.copy(), np.full(count, -1.0)
    energy0 = _products(template, template)
    for _ in range(iterations + 1):
        seen = _centred(_sample(image1, xy[:, :1] + across[:, 0], xy[:, 1:] + across[:, 1]))
        energy1, both = _products(seen, seen), _products(seen, template)
        correlation = both / np.sqrt(np.maximum(energy0 * energy1, 1e-9))
        gain = np.clip(both / np.maximum(energy1, 1e-9), *_GAIN_RANGE)
        difference = gain[:, None].astype(np.float32) * seen - template
        u, v = _products(slope_x, difference), _products(slope_y, difference)
        # How far the content in sight is from the template's centre, in pixels of the first image.
        away = np.stack([c * u - b * v, a * v - b * u], axis=1) / determinant[:, None]
        step = np.where(usable[:, None], np.einsum("nij,nj->ni", warps, away), 0.0)
        if float(np.abs(step).max()) < _SMALL_STEP_PX:
            break
        xy = xy - step
    sound = usable & np.isfinite(xy).all(axis=1)
    return AlignedPatches(np.where(sound[:, None], xy, start1_xy), np.where(sound, correlation, -1.0))


def _sample(image: Grey, x: Array, y: Array) -> Values:
    """Bilinear values at ``(N, M)`` pixels; the border goes on outside."""
    grey = image.astype(np.float32)
    at = x.astype(np.float32), y.astype(np.float32)
    return np.asarray(
        cv2.remap(grey, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32
    )


def _centred(values: Values) -> Values:
    return np.asarray(values - values.mean(axis=1, keepdims=True))


def _products(values0: Values, values1: Values) -> Array:
    return np.asarray(np.einsum("nm,nm->n", values0, values1), dtype=np.float64)
