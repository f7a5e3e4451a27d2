"""Keypoints: corners spread over the image, tracking from frame to frame, descriptors on keyframes."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.brightness import brightness_change, with_brightness
from semcast.server.geometry.cells import cell_keys
from semcast.server.geometry.sampling import nearest_pixels

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: Points nearer to the border have no whole window.
BORDER_PX = 8
#: Pixels to each side within which a corner is the strongest, and its distance from points that are followed,
_FAR_APART = (3, 7)
#: and the same where all that can be followed is small in the picture, and there are too few of the others.
_CLOSE_TOGETHER = (1, 3)
#: Side of the window by which a point that was found is placed. The large one finds it, and tells whether it
#: is the same; but it reaches past the outline of what the point is on, and over surfaces turned otherwise.
_FINE_WINDOW_PX = 15
#: When a search ends: its steps, and the length of one in pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)
#: Distance in pixels within which a point that is followed forth and back must be back.
MAX_FORWARD_BACKWARD_PX = 1.5
#: A small window that ends further from there has found something else.
_MAX_FINE_MOVE_PX = 1.5
#: OpenCV's KLT gives the smaller eigenvalue of the mean structure tensor in units of 32^2 / 2^20 grey^2.
_EIGEN_UNIT = 1024.0
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
_ORB_SCALE = 1.2
#: Bits by which matched descriptors may differ, and their share of those to the second nearest at most;
_MAX_DISTANCE, _MAX_RATIO = 64, 0.9
#: the same where matches are only counted.
_MAX_DISTANCE_COUNTED, _MAX_RATIO_COUNTED = 60, 0.75
#: Rows whose distances are counted at a time: what is between stays in a cache.
_BLOCK = 32
#: Share of the points that must be found in spite of another exposure for them to tell it surely,
_MOSTLY_FOUND = 0.6
#: and pyramid levels of the second search then.
_LEVELS_ANEW = 1
#: Points that tell whether guesses are near, though the exposure may be another one: of at least this factor
#: as many, or all are as soon found;
_NUM_SCOUTS, _LEAST_STEP = 40, 3
#: the share of them that must be found, and how far from where they are guessed they typically may be.
_SCOUTS_FOUND, _NEAR_PX = 0.4, 2.0
#: Two changes of brightness are one where they make as much of these grey levels, but for so much: what that
#: moves a point by, the small window takes back.
_LEVELS_GREY, _SAME_LIGHT_GREY = np.array([64.0, 192.0]), 4.0
#: With fewer, what they tell is right if it finds this factor as many.
_CLEARLY_MORE = 1.2


def to_grey(image: NDArray[np.uint8]) -> Grey:
    """Return the ``(H, W)`` uint8 grey image of an ``(H, W, 3)`` RGB image."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


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


@dataclass(frozen=True)
class TrackedPoints:
    """Where points went.

    Attributes:
        xy: ``(N, 2)`` float64 pixels in the second image.
        ok: ``(N,)`` bool: found, inside, and found again backwards.
        forward_backward_px: ``(N,)`` distance of the way there and back from its start.
        photometric_grey: ``(N,)`` mean absolute difference of the windows in grey levels.
        gradient_grey2: ``(N,)`` smaller eigenvalue of the second window's structure tensor, mean per pixel.
    """

    xy: Array
    ok: NDArray[np.bool_]
    forward_backward_px: Array
    photometric_grey: Array
    gradient_grey2: Array

    def strongest(self, count: int) -> "TrackedPoints":
        """Return the same points, of which at most ``count`` with the steepest gradients are ``ok``."""
        rows = np.flatnonzero(self.ok)
        chosen = rows[np.argsort(-self.gradient_grey2[rows], kind="stable")[:count]]
        ok = np.zeros(len(self.ok), bool)
        ok[chosen] = True
        return replace(self, ok=ok)

    def but_for(self, rows: NDArray[np.bool_], others: "TrackedPoints") -> "TrackedPoints":
        """Return these points but for some ``rows (N,)``, which are the ``(M,)`` of another set."""
        parts = {name: values.copy() for name, values in vars(self).items()}
        for name, values in vars(others).items():
            parts[name][rows] = values
        return TrackedPoints(**parts)

    @staticmethod
    def none(count: int) -> "TrackedPoints":
        """No point was found."""
        return TrackedPoints(
            np.zeros((count, 2)), np.zeros(count, bool), np.full(count, 9.0), np.zeros(count), np.zeros(count)
        )


def track_points(
    grey0: Grey,
    grey1: Grey,
    xy0: Array,
    guess1_xy: Array,
    *,
    max_level: int = 3,
) -> TrackedPoints:
    """Follow points by Lucas-Kanade, there and back.

    Where the points that are found tell that the exposure changed, the first image is brought to that of the
    second and all are followed anew.

    Args:
        grey0: Image the points are known in.
        grey1: Image they are looked for in.
        xy0: ``(N, 2)`` pixels in ``grey0``.
        guess1_xy: ``(N, 2)`` where they are expected in ``grey1``.
        max_level: Pyramid levels above the full image.
    """
    return track_through_light(grey0, grey1, xy0, guess1_xy, max_level=max_level)[0]


def track_through_light(
    grey0: Grey,
    grey1: Grey,
    xy0: Array,
    guess1_xy: Array,
    *,
    max_level: int = 3,
) -> tuple[TrackedPoints, tuple[float, float] | None]:
    """Follow points as ``track_points`` does, and tell the change of brightness that was made up for.

    Returns:
        The points; gain and offset from the first image to the second, None where there is no change.
    """
    count = len(xy0)
    if count == 0 or grey0.shape != grey1.shape:
        return TrackedPoints.none(count), None
    told = _light_at_guesses(grey0, grey1, xy0, guess1_xy, max_level)
    like_second, is_told = _in_light(grey0, told), told is not None
    found = _search(like_second, grey1, xy0, guess1_xy, max_level)
    for _ in range(2):
        # Where hardly any was found, the guesses are near enough for a first idea of the change.
        is_sure = bool(found.ok.mean() >= _MOSTLY_FOUND)
        if not is_sure and is_told:
            break  # what guesses told was found true, and they tell no more now
        rows = found.ok if is_sure else np.ones(count, bool)
        xy1 = np.where(found.ok[:, None], found.xy, guess1_xy)
        change = brightness_change(grey0, grey1, xy0[rows], xy1[rows])
        alike = _in_light(grey0, change)
        if _is_same_light(told, change):
            if is_sure:
                like_second, told = alike, change
            break
        levels = min(_LEVELS_ANEW, max_level) if is_sure else max_level
        anew = _search(alike, grey1, xy0, xy1, levels)
        if anew.ok.sum() < (1.0 if is_sure else _CLEARLY_MORE) * found.ok.sum():
            break
        found, like_second, told = anew, alike, change
        if is_sure:
            break
    return _placed(like_second, grey1, xy0, found), told


def _light_at_guesses(
    grey0: Grey, grey1: Grey, xy0: Array, guess1_xy: Array, max_level: int
) -> tuple[float, float] | None:
    """Change of brightness where points are guessed to be, so that they need not be looked for twice.

    One that is too large for the small window to make up for is believed where a few of them are found about
    there. If all guesses are off to one side, light that falls off along a wall looks like a change, and
    points would be found where it says.
    """
    step = len(xy0) // _NUM_SCOUTS
    if step < _LEAST_STEP:
        return None
    change = brightness_change(grey0, grey1, xy0, guess1_xy, KLT_WINDOW_PX)
    if _is_same_light(None, change):
        return None
    guess = guess1_xy[::step]
    found = _search(grey0, grey1, xy0[::step], guess, max_level)
    if found.ok.mean() < _SCOUTS_FOUND:
        return None
    off_px = np.abs(np.median((found.xy - guess)[found.ok], axis=0)).max()
    return change if off_px < _NEAR_PX else None


def _is_same_light(one: tuple[float, float] | None, other: tuple[float, float] | None) -> bool:
    (gain0, offset0), (gain1, offset1) = one or (1.0, 0.0), other or (1.0, 0.0)
    return bool(np.abs((gain0 - gain1) * _LEVELS_GREY + offset0 - offset1).max() < _SAME_LIGHT_GREY)


def _in_light(grey: Grey, change: tuple[float, float] | None) -> Grey:
    return grey if change is None else with_brightness(grey, *change)


def track_alike(
    grey0: Grey,
    grey1: Grey,
    xy0: Array,
    guess1_xy: Array,
    *,
    max_level: int = 3,
) -> TrackedPoints:
    """Follow points as ``track_points`` does between images that are known to have the same brightness."""
    if len(xy0) == 0 or grey0.shape != grey1.shape:
        return TrackedPoints.none(len(xy0))
    found = _search(grey0, grey1, xy0, guess1_xy, max_level)
    return _placed(grey0, grey1, xy0, found)


def _search(grey0: Grey, grey1: Grey, xy0: Array, guess1_xy: Array, max_level: int) -> TrackedPoints:
    """Find points by a large window, there and back, between images of the same brightness."""
    height, width = grey1.shape
    start = np.ascontiguousarray(xy0, dtype=np.float32)
    guess = np.clip(np.nan_to_num(guess1_xy), (0, 0), (width - 1, height - 1)).astype(np.float32)
    window = (KLT_WINDOW_PX, KLT_WINDOW_PX)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    found, status, error = cv2.calcOpticalFlowPyrLK(
        grey0, grey1, start, guess.copy(), None, None, window, max_level, _CRITERIA, flags, 1e-4
    )
    found = np.nan_to_num(found.reshape(-1, 2), nan=-1e4, posinf=-1e4, neginf=-1e4)
    inside = (found[:, 0] >= 1) & (found[:, 1] >= 1) & (found[:, 0] < width - 2) & (found[:, 1] < height - 2)
    ok = inside & (status.ravel() == 1)
    distance, gradient = np.full(len(xy0), 99.0), np.zeros(len(xy0))
    there = np.flatnonzero(ok)
    if len(there):
        begin = start[there]
        back_guess = np.clip(begin + (guess[there] - found[there]), begin - 20.0, begin + 20.0)
        how = (window, min(2, max_level), _CRITERIA, flags | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS, 1e-4)
        back, back_status, eigen = cv2.calcOpticalFlowPyrLK(
            grey1, grey0, found[there], back_guess.astype(np.float32), None, None, *how
        )
        away = np.linalg.norm(back.reshape(-1, 2).astype(np.float64) - begin, axis=1)
        distance[there] = np.where((back_status.ravel() == 1) & np.isfinite(away), away, 99.0)
        gradient[there] = _where_found(np.asarray(eigen), np.asarray(back_status)) * _EIGEN_UNIT
    ok &= distance <= MAX_FORWARD_BACKWARD_PX
    return TrackedPoints(
        xy=found.astype(np.float64),
        ok=ok,
        forward_backward_px=distance,
        photometric_grey=_where_found(np.asarray(error), np.asarray(status)),
        gradient_grey2=gradient,
    )


def _placed(grey0: Grey, grey1: Grey, xy0: Array, found: TrackedPoints) -> TrackedPoints:
    """Put the points that are ``ok`` where a small window has them."""
    rows = np.flatnonzero(found.ok)
    if len(rows) == 0:
        return found
    start, large = xy0[rows].astype(np.float32), found.xy[rows].astype(np.float32)
    window, flags = (_FINE_WINDOW_PX, _FINE_WINDOW_PX), cv2.OPTFLOW_USE_INITIAL_FLOW
    small, status, _ = cv2.calcOpticalFlowPyrLK(
        grey0, grey1, start, large.copy(), None, None, window, 0, _CRITERIA, flags, 1e-4
    )
    small = small.reshape(-1, 2)
    near = (status.ravel() == 1) & (np.abs(small - large).max(axis=1) < _MAX_FINE_MOVE_PX)
    xy = found.xy.copy()
    xy[rows[near]] = small[near]
    return replace(found, xy=xy)


def _where_found(values: NDArray[Any], status: NDArray[Any]) -> Array:
    """KLT's error column; 0 for points that were not found, where it is not initialised."""
    usable = (status.ravel() == 1) & np.isfinite(values.ravel())
    return np.where(usable, values.ravel(), np.float32(0.0)).astype(np.float64)


def deduplicate(keypoints_xy: Array, cell_px: float = 2.0) -> NDArray[np.bool_]:
    """Mark the first of all points ``(N, 2)`` that share a cell of this side, ``(N,)`` bool."""
    cells = np.floor(keypoints_xy / cell_px).astype(np.int64)
    _, first = np.unique(cell_keys(cells), return_index=True)
    keep = np.zeros(len(keypoints_xy), bool)
    keep[first] = True
    return keep


class Describer:
    """Binary descriptors (ORB, upright) of given points, and their matching."""

    def __init__(self) -> None:
        self._orb = cv2.ORB.create(
            nfeatures=5000, scaleFactor=_ORB_SCALE, nlevels=5, edgeThreshold=16, patchSize=31
        )

    def describe(
        self, grey: Grey, keypoints_xy: Array, octaves: tuple[int, ...] = (0,)
    ) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Describe points, each at every given octave of a pyramid with factor 1.2.

        Args:
            grey: ``(H, W)``; in images with a side below 64 nothing is described.
            keypoints_xy: ``(N, 2)`` pixels.
            octaves: From 0, the image as it is, to 4.

        Returns:
            ``(M,)`` row of each descriptor's point and ``(M, 32)`` uint8 descriptors; points near the
            border have none.
        """
        keypoints = [
            cv2.KeyPoint(float(x), float(y), 31.0 * _ORB_SCALE**octave, 0.0, 1.0, octave, row)
            for octave in octaves
            for row, (x, y) in enumerate(keypoints_xy)
        ]
        if not keypoints or min(grey.shape) < 64:
            return np.zeros(0, np.intp), np.zeros((0, 32), np.uint8)
        kept, descriptors = self._orb.compute(grey, keypoints)
        if descriptors is None or not len(kept):
            return np.zeros(0, np.intp), np.zeros((0, 32), np.uint8)
        rows = np.array([k.class_id for k in kept], dtype=np.intp)
        return rows, np.asarray(descriptors, dtype=np.uint8)


def hamming(descriptors0: NDArray[np.uint8], descriptors1: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Number of different bits of descriptors, row by row, ``(N,)``."""
    return np.asarray(np.bitwise_count(descriptors0 ^ descriptors1).sum(axis=1, dtype=np.int64))


def _hamming_distances(
    descriptors0: NDArray[np.uint8], descriptors1: NDArray[np.uint8]
) -> NDArray[np.uint16]:
    """Number of different bits of each pair of descriptors, ``(N, M)``; half the time of OpenCV's matcher."""
    words0, words1 = (np.ascontiguousarray(d).view(np.uint64) for d in (descriptors0, descriptors1))
    distances = np.zeros((len(words0), len(words1)), np.uint16)
    for first in range(0, len(words0), _BLOCK):
        block = distances[first : first + _BLOCK]
        for of0, of1 in zip(words0[first : first + _BLOCK].T, words1.T, strict=True):
            block += np.bitwise_count(of0[:, None] ^ of1)
    return distances


def _two_nearest(
    distances: NDArray[np.uint16],
) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]:
    """Column of the least of each row of distances ``(N, M)``, it and the second least, each ``(N,)``."""
    rows, best = np.arange(len(distances)), distances.argmin(axis=1)
    nearest = distances[rows, best].astype(np.int64)
    others = distances.copy()
    others[rows, best] = np.iinfo(np.uint16).max
    return best, nearest, others.min(axis=1).astype(np.int64)


def count_matches(descriptors0: NDArray[np.uint8], descriptors1: NDArray[np.uint8]) -> int:
    """Count the descriptors of one set ``(N, 32)`` that clearly have a nearest one in the other ``(M, 32)``.

    It tells with some of an image's descriptors which of many images deserve ``match_descriptors``.
    """
    if len(descriptors0) == 0 or len(descriptors1) < 2:
        return 0
    _, first, second = _two_nearest(_hamming_distances(descriptors0, descriptors1))
    return int((first <= np.minimum(_MAX_DISTANCE_COUNTED, _MAX_RATIO_COUNTED * second)).sum())


def match_descriptors(
    descriptors0: NDArray[np.uint8], descriptors1: NDArray[np.uint8]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Match descriptors that are each other's nearest, and clearly so; rows into both, best first.

    Args:
        descriptors0: ``(N, 32)``; several may describe the same point (other octaves).
        descriptors1: ``(M, 32)``, each of another point.
    """
    if len(descriptors0) == 0 or len(descriptors1) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distances = _hamming_distances(descriptors0, descriptors1)
    best, first, second = _two_nearest(distances)
    is_clear = first <= np.minimum(_MAX_DISTANCE, _MAX_RATIO * second)
    rows = np.flatnonzero(is_clear & (distances.argmin(axis=0)[best] == np.arange(len(best))))
    rows = rows[np.argsort(first[rows], kind="stable")]
    return rows, best[rows]
