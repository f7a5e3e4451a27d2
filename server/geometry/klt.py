"""Points followed from image to image (Lucas-Kanade), forth and back, also through a change of light."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.brightness import brightness_change, with_brightness
from semcast.server.geometry.grey import Grey

Array = NDArray[np.float64]

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
