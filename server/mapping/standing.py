"""Tracks that stand in the image while the scene moves through it: a bonnet, a watermark, dirt on the lens.

They never leave the image, and each frame adds to them, until they are most of all tracks: what is seen of
the scene is too little then, and a start waits for ever for a camera that seems to stand still. Whether the
scene moves is therefore asked of the image's area, not of the tracks. Something large that drives past a
camera that stands still moves through less than half of it. So does what turns on a turntable, where the rest
of the image stands for good: nothing but what the user says tells one from the other.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.cells import cell_keys

Array = NDArray[np.float64]

#: A track stands while it is no further from where it began than this share of the image's width,
_STANDING_SHARE = 0.0015
#: or than this, whichever is more,
_STANDING_PX = 1.0
#: or than what its noise explains, in standard deviations.
_NOISE_SIGMAS = 2.0
#: How far the scene must move, in image widths, while a track stands for it to be fixed to the camera. A
#: point so far away that it stands as long is in the direction the camera moves, and few are.
_SCENE_WIDTHS = 0.1
#: From this motion of the scene on a standing track is suspected to be fixed to the camera,
_SUSPECT_WIDTHS = 0.006
#: where more than this share of all tracks are: of what is at rest, a twentieth stands in images of a car
#: that goes straight on, and less elsewhere.
_MANY_SHARE = 0.1
#: Cells along the width by which the area counts.
_COLUMNS = 12
#: Less than this from one frame to the next is no motion, but noise.
_LEAST_MOTION_PX = 0.5
#: Fewer tracks that move are no turntable, but slipped.
_MIN_TURNING = 12


def cells_of(xy: Array, width: int) -> NDArray[np.intp]:
    """Which cell of the image each of ``(N, 2)`` pixels is in, ``(N,)``; cells with none have no number."""
    cells = np.floor(xy * (_COLUMNS / width)).astype(np.int64)
    _, group = np.unique(cell_keys(cells), return_inverse=True)
    return np.asarray(group, dtype=np.intp)


def scene_motion_px(xy: Array, motion_px: Array, width: int, moving_sd_px: Array | None = None) -> float:
    """How far the scene moved in the image from one frame to the next: the median over its area.

    Args:
        xy: ``(N, 2)`` tracks.
        motion_px: ``(N,)`` how far each moved.
        width: Of the image.
        moving_sd_px: ``(N,)`` standard deviation of a position per coordinate, where only what moves by more
            than that explains is the scene, as on a turntable; None where all of it is.
    """
    if moving_sd_px is not None:
        moves = motion_px >= np.maximum(_LEAST_MOTION_PX, _NOISE_SIGMAS * np.sqrt(2.0) * moving_sd_px)
        if moves.sum() < _MIN_TURNING:
            return 0.0
        xy, motion_px = xy[moves], motion_px[moves]
    if len(xy) == 0:
        return 0.0
    group = cells_of(xy, width)
    order = np.lexsort((motion_px, group))
    begins = np.searchsorted(group[order], np.arange(group.max() + 1))
    middle = begins + (np.bincount(group) - 1) // 2
    motion = float(np.median(motion_px[order[middle]]))
    return motion if motion >= _LEAST_MOTION_PX else 0.0


def least_motion_px(width: int, sd_px: Array | float) -> Array:
    """How far a track may move and still stands: for a standard deviation of a position per coordinate."""
    # Both ends of what it moved are noisy.
    noise_px = _NOISE_SIGMAS * np.sqrt(2.0) * np.asarray(sd_px)
    return np.asarray(np.maximum(max(_STANDING_PX, _STANDING_SHARE * width), noise_px))


def stood(
    xy: Array,
    anchor_xy: Array,
    widths: Array,
    scene_px: Array | float,
    width: int,
    sd_px: Array | float = 0.0,
) -> tuple[Array, Array]:
    """Count on how far the scene went while tracks stood.

    Args:
        xy: ``(N, 2)`` where they are now.
        anchor_xy: ``(N, 2)`` where each began to stand.
        widths: ``(N,)`` image widths the scene went since.
        scene_px: How far it went with this frame, for all tracks or ``(N,)``.
        width: Of the image.
        sd_px: Standard deviation of a position per coordinate, for all tracks or ``(N,)``.

    Returns:
        The new ``anchor_xy`` and ``widths``: a track that moved begins anew where it is.
    """
    stands = np.linalg.norm(xy - anchor_xy, axis=1) <= least_motion_px(width, sd_px)
    return np.where(stands[:, None], anchor_xy, xy), np.where(stands, widths + scene_px / width, 0.0)


def is_fixed(widths: Array) -> NDArray[np.bool_]:
    """Which tracks belong to the camera: the scene went ``(N,)`` image widths while they stood."""
    return np.asarray(widths >= _SCENE_WIDTHS)


def may_be_fixed(widths: Array) -> NDArray[np.bool_]:
    """Which tracks may belong to the camera: too many stand to be far away, too shortly to be sure."""
    may = (widths >= _SUSPECT_WIDTHS) & ~is_fixed(widths)
    return np.asarray(may & (may.sum() > _MANY_SHARE * len(may)))
