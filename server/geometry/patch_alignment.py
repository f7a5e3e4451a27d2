"""Alignment of patches between two images that may see them turned and at another scale.

Inverse compositional Lucas-Kanade (Baker and Matthews 2004) with a known affine warp: only the position is
searched for, so that the template's derivatives are computed once. All patches are worked on together.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.projection import MIN_DEPTH_MAP, projection_jacobian
from semcast.server.geometry.sampling import bilinear

Array = NDArray[np.float64]
Values = NDArray[np.float32]

#: Side of the patches by which drift is taken out of tracks. A warp by depth alone takes them for planes that
#: face the camera: on floors, ceilings and walls beside the way larger ones err by more than they average
#: noise out.
ANCHOR_PATCH_PX = 17
#: A track that would move further than this has found something else,
_MAX_MOVE_PX = 3.0
#: as has one whose normalised correlation is lower than this.
_MIN_CORRELATION = 0.7
#: Distance of the pixels of a window that are compared: noise of decoded images is alike over several.
_STRIDE_PX = 2
#: Range of the contrast of one patch against the other.
_GAIN_RANGE = (0.5, 2.0)
#: Patches that move less in a step are there.
_SMALL_STEP_PX = 0.03
#: A structure tensor whose determinant is smaller than this share of its squared trace is an edge.
_MIN_CORNERNESS = 1e-6
#: A patch that is seen at less than this share of its area, or more than its inverse, has other details.
MIN_AREA_RATIO = 0.4


@dataclass(frozen=True)
class Templates:
    """Patches to be looked for, with their mean taken off.

    Attributes:
        values: ``(N, M)`` float32.
        slope_x: ``(N, M)`` float32 derivatives along x.
        slope_y: ``(N, M)`` float32 derivatives along y.
        dx: ``(M,)`` float32 offset of each value from the centre.
        dy: ``(M,)``.
    """

    values: Values
    slope_x: Values
    slope_y: Values
    dx: Values
    dy: Values

    @staticmethod
    def cut(
        image: Grey, centres_xy: Array, window_px: int = KLT_WINDOW_PX, stride_px: int = _STRIDE_PX
    ) -> "Templates":
        """Cut the windows around ``(N, 2)`` pixels of an image; beyond the border its last values go on.

        Args:
            image: ``(H, W)``.
            centres_xy: ``(N, 2)``.
            window_px: Side of a window, odd.
            stride_px: Every so many pixels of it are looked at.
        """
        half = window_px // 2
        offset = np.arange(-half, half + 1, stride_px, dtype=np.float32)
        dy, dx = (d.ravel() for d in np.meshgrid(offset, offset, indexing="ij"))
        x, y = (centres_xy[:, k : k + 1].astype(np.float32) for k in range(2))
        grey = image.astype(np.float32)
        east, west = bilinear(grey, x + dx + 1, y + dy), bilinear(grey, x + dx - 1, y + dy)
        south, north = bilinear(grey, x + dx, y + dy + 1), bilinear(grey, x + dx, y + dy - 1)
        return Templates(
            values=_centred(bilinear(grey, x + dx, y + dy)),
            slope_x=_centred(0.5 * (east - west)),
            slope_y=_centred(0.5 * (south - north)),
            dx=dx,
            dy=dy,
        )

    @staticmethod
    def join(parts: "list[Templates]") -> "Templates":
        """Put templates of several images, cut alike, into one set; of one image at least."""
        return Templates(
            values=np.concatenate([p.values for p in parts]),
            slope_x=np.concatenate([p.slope_x for p in parts]),
            slope_y=np.concatenate([p.slope_y for p in parts]),
            dx=parts[0].dx,
            dy=parts[0].dy,
        )

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True)
class AlignedPatches:
    """Where patches are in an image.

    Attributes:
        xy: ``(N, 2)`` pixels.
        correlation: ``(N,)`` in [-1, 1], zero-mean normalised cross-correlation before the last step, which
            is a small one where the search came to rest; -1 where the patch has too little structure or the
            search left the numbers.
    """

    xy: Array
    correlation: Array

    def fits(self, expected_xy: Array) -> NDArray[np.bool_]:
        """Which show what they were cut from, ``(N,)``: alike enough, and near ``(N, 2)`` tracks."""
        near = np.linalg.norm(self.xy - expected_xy, axis=1) < _MAX_MOVE_PX
        return np.asarray(near & (self.correlation > _MIN_CORRELATION))


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
    projection = projection_jacobian(camera, np.column_stack([x, y, np.where(front, depth1, 1.0)]))
    in_plane = R[:, :2] / np.array([camera.fx, camera.fy])
    warps = projection @ in_plane * depth0_map[:, None, None]
    return np.where(front[:, None, None], warps, np.eye(2)), depth1


def seen_alike(warps: Array, depth1_map: Array) -> NDArray[np.bool_]:
    """Which patches the second camera sees, not so much smaller or larger that details differ.

    Args:
        warps: ``(N, 2, 2)`` as ``affine_warps`` gives them.
        depth1_map: ``(N,)`` depths, as well.
    """
    area = np.linalg.det(warps)
    return np.asarray((depth1_map > MIN_DEPTH_MAP) & (area > MIN_AREA_RATIO) & (area < 1.0 / MIN_AREA_RATIO))


def align_patches(
    templates: Templates, image: Grey, start_xy: Array, warps: Array, *, iterations: int = 6
) -> AlignedPatches:
    """Find where templates are in an image.

    Brightness and contrast of each patch may differ.

    Args:
        templates: N patches, of any images.
        image: Image they are looked for in.
        start_xy: ``(N, 2)`` starts, right to about two pixels.
        warps: ``(N, 2, 2)`` derivatives of pixels in ``image`` by those of the template.
        iterations: Steps at most.
    """
    xy, correlation = start_xy.copy(), np.full(len(templates), -1.0)
    if len(templates) == 0:
        return AlignedPatches(xy, correlation)
    slopes = templates.slope_x, templates.slope_y
    a, b, c = (_products(slopes[j], slopes[k]) for j, k in ((0, 0), (0, 1), (1, 1)))
    determinant = a * c - b * b
    usable = determinant > _MIN_CORNERNESS * (a + c) ** 2
    grey = image.astype(np.float32)
    across = warps.astype(np.float32)
    across_x = across[:, 0, :1] * templates.dx + across[:, 0, 1:] * templates.dy
    across_y = across[:, 1, :1] * templates.dx + across[:, 1, 1:] * templates.dy
    energy = _products(templates.values, templates.values)
    moving = np.flatnonzero(usable)
    for _ in range(iterations):
        if len(moving) == 0:
            break
        x, y = (xy[moving, k : k + 1].astype(np.float32) for k in range(2))
        seen = _centred(bilinear(grey, x + across_x[moving], y + across_y[moving]))
        template = templates.values[moving]
        seen_energy, both = _products(seen, seen), _products(seen, template)
        correlation[moving] = both / np.sqrt(np.maximum(energy[moving] * seen_energy, 1e-9))
        gain = np.clip(both / np.maximum(seen_energy, 1e-9), *_GAIN_RANGE)
        difference = gain[:, None].astype(np.float32) * seen - template
        u, v = (_products(slope[moving], difference) for slope in slopes)
        # How far the content in sight is from the template's centre, in pixels of the template.
        a_, b_, c_, d_ = (terms[moving] for terms in (a, b, c, determinant))
        away = np.stack([c_ * u - b_ * v, a_ * v - b_ * u], axis=1) / d_[:, None]
        step = np.einsum("nij,nj->ni", warps[moving], away)
        xy[moving] -= step
        moving = moving[np.abs(step).max(axis=1) >= _SMALL_STEP_PX]
    sound = usable & np.isfinite(xy).all(axis=1)
    return AlignedPatches(np.where(sound[:, None], xy, start_xy), np.where(sound, correlation, -1.0))


def _centred(values: Values) -> Values:
    return np.asarray(values - values.mean(axis=1, keepdims=True))


def _products(values0: Values, values1: Values) -> Array:
    return np.asarray(np.einsum("nm,nm->n", values0, values1), dtype=np.float64)
