"""Corners to follow: strong ones, spread over the image, and none that noise makes."""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.cells import cell_keys
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.sampling import nearest_pixels

Array = NDArray[np.float64]

#: Points nearer to the border have no whole window.
BORDER_PX = 8
#: Pixels to each side within which a corner is the strongest, and its distance from points that are followed,
_FAR_APART = (3, 7)
#: and the same where all that can be followed is small in the picture, and there are too few of the others.
_CLOSE_TOGETHER = (1, 3)
#: Corners weaker than this mean gradient energy (grey levels^2 per pixel^2) are noise: of a sensor with
#: 1.5 grey levels of it a tenth of the pixels has as much. Bare walls and floors have little that is
#: stronger, and the noise model knows what it is worth.
_MIN_EIGEN_GREY2 = 0.5
#: Nor are corners weaker than this share of the strongest worth following.
_MIN_EIGEN_SHARE = 0.0005
#: Corners that sensor noise makes on plain ground are weaker than this factor times its gradient energy.
_NOISE_FACTOR = 3.0
#: Nor has a sensor more than that of four grey levels: what is rougher all over is gravel or grass.
_MOST_NOISE_GREY2 = 12.0 / 64.0 * 4.0**2
#: Side of the cells by which noise is told,
_NOISE_CELL_PX = 16
#: and the share of them, of the least roughness, that is taken for plain ground.
_PLAIN_SHARE = 0.2
_ROUGHNESS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def corner_strength(grey: Grey, block_px: int = 5) -> NDArray[np.float32]:
    """Smaller eigenvalue of the mean structure tensor of each block, ``(H, W)`` grey levels^2 per pixel^2."""
    scaled = cv2.cornerMinEigenVal(grey, block_px, ksize=3)
    return np.asarray(scaled * np.float32(255.0**2 / 4.0), dtype=np.float32)


def detect_corners(
    grey: Grey,
    num_wanted: int,
    occupied_xy: Array | None = None,
    usable: NDArray[np.bool_] | None = None,
    cell_px: int = 48,
    strength: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Find corners, spread over the image by taking the strongest of every cell.

    Args:
        grey: ``(H, W)``.
        num_wanted: At most so many.
        occupied_xy: ``(M, 2)`` keypoints that are there already: their neighbourhood is left out and
            counts for its cell.
        usable: ``(H, W)`` bool, False where no corner may be taken (lost bands).
        cell_px: Side of a cell.
        strength: ``corner_strength(grey)`` where it is known already.

    Returns:
        ``(N, 2)`` float32 pixels, strongest first within each round over the cells.
    """
    height, width = grey.shape
    if num_wanted <= 0 or height <= 2 * BORDER_PX or width <= 2 * BORDER_PX:
        return np.zeros((0, 2), np.float32)
    strength = corner_strength(grey) if strength is None else strength
    floor = max(
        _MIN_EIGEN_GREY2, _MIN_EIGEN_SHARE * float(strength.max()), _NOISE_FACTOR * noise_energy_grey2(grey)
    )
    peak_reach, free_reach = _FAR_APART
    peak = _peaks(strength, floor, peak_reach)
    num_occupied = 0 if occupied_xy is None else len(occupied_xy)
    if np.count_nonzero(peak) < num_wanted + num_occupied:
        peak_reach, free_reach = _CLOSE_TOGETHER
        peak = _peaks(strength, floor, peak_reach)
    peak[:BORDER_PX] = peak[-BORDER_PX:] = False
    peak[:, :BORDER_PX] = peak[:, -BORDER_PX:] = False
    if usable is not None:
        peak &= usable
    columns = -(-width // cell_px)
    num_cells = columns * -(-height // cell_px)
    counts = np.zeros(num_cells, np.int64)
    if occupied_xy is not None and len(occupied_xy):
        x, y = nearest_pixels(occupied_xy, grey.shape).T
        near = np.zeros((height, width), np.uint8)
        near[y, x] = 1
        peak &= cv2.dilate(near, _square(free_reach)) == 0
        counts = np.bincount(y // cell_px * columns + x // cell_px, minlength=num_cells)
    ys, xs = np.nonzero(peak)
    if len(xs) == 0:
        return np.zeros((0, 2), np.float32)
    value = strength[ys, xs]
    cell = ys // cell_px * columns + xs // cell_px
    order = np.lexsort((-value, cell))
    cell, value, xs, ys = cell[order], value[order], xs[order], ys[order]
    first = np.searchsorted(cell, cell)
    turn = np.arange(len(cell)) - first + counts[cell]
    chosen = np.lexsort((-value, turn))[:num_wanted]
    corners = np.stack([xs[chosen], ys[chosen]], axis=1).astype(np.float32)
    refined = cv2.cornerSubPix(
        grey, corners.reshape(-1, 1, 2).copy(), (3, 3), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 5, 0.03)
    ).reshape(-1, 2)
    far = ~(np.abs(refined - corners).max(axis=1) <= 3.0)
    refined[far] = corners[far]
    return np.asarray(refined, dtype=np.float32)


def noise_energy_grey2(grey: Grey) -> float:
    """Mean gradient energy that the noise of the sensor adds to every pixel, grey levels^2 per pixel^2.

    Noise is what plain parts of the image have of the second differences that edges and shades have least of
    (Immerkaer, "Fast noise variance estimation", 1996).
    """
    size = (max(1, grey.shape[1] // _NOISE_CELL_PX), max(1, grey.shape[0] // _NOISE_CELL_PX))
    rough = np.abs(cv2.filter2D(grey, cv2.CV_32F, _ROUGHNESS))
    plain = float(np.quantile(cv2.resize(rough, size, interpolation=cv2.INTER_AREA), _PLAIN_SHARE))
    # The filter has a norm of 6, the mean size of a Gaussian value is sqrt(2 / pi) sigma, and the derivatives
    # of ``corner_strength`` keep 12 / 64 of the variance.
    return min(12.0 / 64.0 * np.pi / 2.0 * (plain / 6.0) ** 2, _MOST_NOISE_GREY2)


def _peaks(strength: NDArray[np.float32], floor: float, reach_px: int) -> NDArray[np.bool_]:
    """Which pixels are the strongest within a reach to each side, and stronger than the floor."""
    return np.asarray((strength >= cv2.dilate(strength, _square(reach_px))) & (strength > floor))


def _square(reach_px: int) -> NDArray[np.uint8]:
    return np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)


def deduplicate(keypoints_xy: Array, cell_px: float = 2.0) -> NDArray[np.bool_]:
    """Mark the first of all points ``(N, 2)`` that share a cell of this side, ``(N,)`` bool."""
    cells = np.floor(keypoints_xy / cell_px).astype(np.int64)
    _, first = np.unique(cell_keys(cells), return_index=True)
    keep = np.zeros(len(keypoints_xy), bool)
    keep[first] = True
    return keep
