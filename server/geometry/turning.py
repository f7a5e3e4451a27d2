"""How a camera turned between two images, told by small blurred versions of them.

Points need corners and a sharp image. A bare wall has none, turning blurs what there is, and what arrives
over a poor link flickers; but edges and shades still tell how the whole image went (Klein and Murray,
"Improving the agility of keyframe-based SLAM", 2008).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.sampling import bilinear
from semcast.server.geometry.weighting import MAD_TO_SIGMA

Array = NDArray[np.float64]
Small = NDArray[np.float32]

#: Widths of the small images, one after the other: what went by a tenth of the image is within reach of the
#: first.
_WIDTHS_PX = (40, 80)
#: Standard deviation of their blur.
_BLUR_PX = 1.0
_ITERATIONS = 10
#: The search ends with a smaller step.
_SETTLED_RAD = 1e-4
#: Share of the small image that must be in both,
_MIN_SHARED = 0.3
#: and normalised correlation there, at least: less is another view.
_MIN_CORRELATION = 0.8
#: Errors beyond this many standard deviations count less: what is near moves otherwise.
_HUBER_SIGMAS = 1.5
#: Standard deviation of the errors in grey levels, at least.
_LEAST_SD_GREY = 0.3
#: Root mean square change in grey levels that a turn by a radian must make, about every axis: less is noise.
_LEAST_GREY_PER_RAD = 5.0


def turn_between(
    camera: Intrinsics, grey0: Grey, grey1: Grey, way_depths: Array, R_expected: Array | None = None
) -> Array | None:
    """Estimate a rotation by aligning two whole images, another brightness allowed.

    Args:
        camera: Pinhole.
        grey0: ``(H, W)`` first image.
        grey1: ``(H, W)`` second image.
        way_depths: ``(3,)`` where the second camera is in the frame of the first, over how far things are:
            what moving does to the image is no turn.
        R_expected: ``R_cam1_cam0 (3, 3)`` from which the search begins as well as from no turn: what goes
            further than a tenth of the image is out of its reach.

    Returns:
        ``R_cam1_cam0 (3, 3)``. None where the images have too little in common, or nothing in them tells.
    """
    starts, correlation = [np.eye(3)] if R_expected is None else [np.eye(3), R_expected], 0.0
    for width_px in _WIDTHS_PX:
        small0, small1 = _small(grey0, width_px), _small(grey1, width_px)
        found = [_aligned(camera, small0, small1, way_depths, R) for R in starts]
        aligned = [a for a in found if a is not None]
        if not aligned:
            return None
        R_cam1_cam0, correlation = max(aligned, key=lambda a: a[1])
        starts = [R_cam1_cam0]
    return starts[0] if correlation > _MIN_CORRELATION else None


def _aligned(
    camera: Intrinsics, small0: Small, small1: Small, way_depths: Array, R_cam1_cam0: Array
) -> tuple[Array, float] | None:
    """Refine a rotation by Gauss and Newton's method; it, and how the images correlate."""
    height, width = small0.shape
    scale = np.array([width / camera.width, height / camera.height])  # a height is rounded to pixels
    slopes = [_slope(small1, dx) for dx in (1, 0)]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    seen_from_there = camera.unproject((pixels + 0.5) / scale - 0.5) - way_depths
    focal_px = scale * np.array([camera.fx, camera.fy])
    centre_px = scale * np.array([camera.cx + 0.5, camera.cy + 0.5]) - 0.5
    correlation = 0.0
    for _ in range(_ITERATIONS):
        rays = seen_from_there @ R_cam1_cam0.T
        at = rays[:, :2] / np.maximum(rays[:, 2:], 0.1)
        xy = at * focal_px + centre_px
        both = ((xy >= 0) & (xy <= (width - 1, height - 1))).all(axis=1) & (rays[:, 2] > 0.1)
        if both.sum() < _MIN_SHARED * len(both):
            return None
        before, now = small0.ravel()[both], _sampled(small1, xy[both])
        correlation = _correlation(before, now)
        slope = np.column_stack([_sampled(image, xy[both]) for image in slopes]) * focal_px
        step = _step(at[both], slope, now - before)
        if step is None:
            return None
        R_cam1_cam0 = exp_so3(step) @ R_cam1_cam0
        if np.abs(step).max() < _SETTLED_RAD:
            break
    return R_cam1_cam0, correlation


def _step(at: Array, slope: Array, error: Array) -> Array | None:
    """Turn ``(3,)`` that takes away errors ``(N,)``, but for a change of brightness; None where none is told.

    Args:
        at: ``(N, 2)`` rays of the second camera at unit depth.
        slope: ``(N, 2)`` grey levels per unit of those.
        error: ``(N,)`` grey levels.
    """
    (x, y), (slope_x, slope_y) = at.T, slope.T
    by_turn = np.column_stack(
        [
            -slope_x * x * y - slope_y * (1 + y * y),
            slope_x * (1 + x * x) + slope_y * x * y,
            slope_y * x - slope_x * y,
            np.ones_like(x),
        ]
    )
    off = np.abs(error - np.median(error))
    limit = _HUBER_SIGMAS * max(_LEAST_SD_GREY, MAD_TO_SIGMA * float(np.median(off)))
    weighted = by_turn * (limit / np.maximum(off, limit))[:, None]
    information = by_turn.T @ weighted
    if np.linalg.eigvalsh(information[:3, :3])[0] < _LEAST_GREY_PER_RAD**2 * len(at):
        return None
    return np.asarray(np.linalg.solve(information, -weighted.T @ error)[:3])


def _small(grey: Grey, width_px: int) -> Small:
    size = (width_px, max(1, round(width_px * grey.shape[0] / grey.shape[1])))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), _BLUR_PX), dtype=np.float32)


def _slope(image: Small, dx: int) -> Small:
    """Grey levels per pixel to the right, or with 0 downwards."""
    return np.asarray(cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125), dtype=np.float32)


def _sampled(image: Small, xy: Array) -> Array:
    at = xy.astype(np.float32)
    return np.asarray(bilinear(image, at[:, :1], at[:, 1:]), dtype=np.float64).ravel()


def _correlation(a: Array, b: Array) -> float:
    return float(((a - a.mean()) * (b - b.mean())).mean() / max(1e-9, a.std() * b.std()))
