"""Bands that flickering lamps leave in the images of a rolling shutter, made up for between two images.

Lamps on 50 or 60 Hz mains flicker at twice that. A rolling shutter exposes one row after the other, so each
image has brighter and darker bands across it, which lie elsewhere in the next one: to Lucas-Kanade, a point
has another brightness on every row, and most are lost. How much brighter each row has become is told by all
of it, wherever single points went: images a few pixels apart show much the same in a row, and what they
don't, the median of its cells leaves out.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.grey import Grey
from semcast.server.geometry.klt import TrackedPoints, track_alike

Array = NDArray[np.float64]

#: Side of the cells whose means are compared: bands are wider, and noise and fine detail are gone.
_CELL_PX = 8
#: Cells outside these grey levels may be clipped.
_DARKEST, _BRIGHTEST = 8.0, 247.0
#: Share of a row's cells that must tell, and rows of cells that must have so many.
_TELLING_SHARE, _LEAST_ROWS = 0.2, 8
#: Weights of neighbouring rows of cells: a band reaches over several of them.
_SMOOTHING = np.array([0.25, 0.5, 0.25])
#: Standard deviation of the rows' log gains below which a small window makes up for them. Clean images that
#: lie alike differ by up to a hundredth, by which slow changes of what is in a row make them.
_LEAST_SD = 0.03
#: Share of the cells' typical change of brightness that gains of rows may leave unexplained. Of bands that is
#: a twentieth to a half, of what moves in clean images more than four fifths.
_MOST_LEFT = 0.7
#: Points by which gains are tried out, of at least so many,
_NUM_SCOUTS, _LEAST_SCOUTS = 60, 20
#: the share of them that must be found then, and by which factor they must be more than without, or their
#: windows more alike,
_SCOUTS_FOUND, _CLEARLY_BETTER = 0.4, 1.2
#: where at least about as many were found.
_AS_MANY = 0.95


def row_gains(grey0: Grey, grey1: Grey, shift_px: Array, usable: NDArray[np.bool_]) -> Array | None:
    """Tell by which factor each row of an image is brighter in another, if rows differ in that.

    Args:
        grey0: ``(H, W)`` first image.
        grey1: ``(H, W)`` second image.
        shift_px: ``(2,)`` about how far what they show moved, in x and y.
        usable: ``(H,)`` rows of the second image that arrived.

    Returns:
        ``(H,)`` factors from the first image to the second, for the first one's rows; None where all are
        about the same, or where too little of the images overlaps.
    """
    height, width = grey0.shape
    dx, dy = (int(v) for v in np.rint(np.clip(np.nan_to_num(shift_px), -height - width, height + width)))
    top, bottom, left, right = max(0, -dy), min(height, height - dy), max(0, -dx), min(width, width - dx)
    columns, rows = (right - left) // _CELL_PX, (bottom - top) // _CELL_PX
    if columns < 1 or rows < _LEAST_ROWS:
        return None
    # Whole cells: OpenCV takes means of others several times as slowly.
    there = slice(top + dy, top + dy + rows * _CELL_PX)
    parts = (
        grey0[top : top + rows * _CELL_PX, left : left + columns * _CELL_PX],
        grey1[there, left + dx : left + dx + columns * _CELL_PX],
    )
    cells0, cells1 = (
        cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64) for part in parts
    )
    tells = (np.minimum(cells0, cells1) > _DARKEST) & (np.maximum(cells0, cells1) < _BRIGHTEST)
    tells &= usable[there].reshape(rows, _CELL_PX).all(axis=1, keepdims=True)
    count = tells.sum(axis=1)
    telling = np.flatnonzero(count >= max(1.0, _TELLING_SHARE * columns))
    if len(telling) < _LEAST_ROWS:
        return None
    ratios = np.log(np.maximum(cells1, 1.0) / np.maximum(cells0, 1.0))
    in_order = np.sort(np.where(tells, ratios, np.inf), axis=1)
    y = top + (np.arange(rows) + 0.5) * _CELL_PX - 0.5
    logs = np.interp(y, y[telling], in_order[telling, count[telling] // 2])
    margin = len(_SMOOTHING) // 2
    logs = np.convolve(np.pad(logs, margin, mode="edge"), _SMOOTHING, mode="valid")
    if logs.std() < _LEAST_SD:
        return None
    unlike, left_over = (
        np.median(np.abs(ratios - around)[tells]) for around in (np.median(ratios[tells]), logs[:, None])
    )
    if left_over > _MOST_LEFT * unlike:
        return None
    return np.asarray(np.exp(np.interp(np.arange(height), y, logs)))


def with_row_gains(grey: Grey, gains: Array) -> Grey:
    """Return an ``(H, W)`` image with each row brighter by a factor ``(H,)``, clipped as a camera clips."""
    bright = np.rint(grey * gains.astype(np.float32)[:, None])
    return np.asarray(np.minimum(bright, 255.0), dtype=np.uint8)


def flicker_between(
    grey0: Grey, grey1: Grey, xy0: Array, guess1_xy: Array, usable: NDArray[np.bool_]
) -> Array | None:
    """Tell gains of rows by which points are found clearly better: only those are bands of light.

    Rows change in brightness too where a scene of level layers moves up and down in the image.

    Args:
        grey0: ``(H, W)`` image the points are known in.
        grey1: ``(H, W)`` image they are looked for in.
        xy0: ``(N, 2)`` pixels in ``grey0``.
        guess1_xy: ``(N, 2)`` where they are expected in ``grey1``.
        usable: ``(H,)`` rows of ``grey1`` that arrived.

    Returns:
        ``(H,)`` as ``row_gains`` tells them, or None.
    """
    if len(xy0) < _LEAST_SCOUTS or grey0.shape != grey1.shape:
        return None
    gains = row_gains(grey0, grey1, np.median(guess1_xy - xy0, axis=0), usable)
    if gains is None:
        return None
    scouts = slice(None, None, max(1, len(xy0) // _NUM_SCOUTS))
    way = xy0[scouts], guess1_xy[scouts]
    even = np.full(len(gains), np.median(gains))  # another exposure is no flicker
    plain = track_alike(with_row_gains(grey0, even), grey1, *way)
    lit = track_alike(with_row_gains(grey0, gains), grey1, *way)
    if lit.ok.mean() < _SCOUTS_FOUND or not _is_clearly_better(lit, plain):
        return None
    # Now it is known how far all moved.
    again = row_gains(grey0, grey1, np.median((lit.xy - way[0])[lit.ok], axis=0), usable)
    return gains if again is None else again


def _is_clearly_better(lit: TrackedPoints, plain: TrackedPoints) -> bool:
    """Tell whether more points were found, or as many whose windows are more alike."""
    both, num_lit, num_plain = lit.ok & plain.ok, lit.ok.sum(), plain.ok.sum()
    if num_lit > _CLEARLY_BETTER * num_plain:
        return True
    if num_lit < _AS_MANY * num_plain or not both.any():
        return False
    unlike_lit, unlike_plain = (np.median(points.photometric_grey[both]) for points in (lit, plain))
    return bool(_CLEARLY_BETTER * unlike_lit < unlike_plain)
