"""How far each match moves as its neighbours do: a sign of a right match that needs no model of the motion.

Neighbours in an image see neighbouring things and move alike; a wrong match goes anywhere (the observation
behind grid-based motion statistics, Bian et al., "GMS", CVPR 2017). On descriptor matches of images decoded
from a poor link it tells right from wrong far better than any confidence (docs/confidence.md has the AUROC).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Nearest matches that are asked.
_NEIGHBOURS = 10
#: Moves may differ by this share of the distance, which turns, zooms and slanted surfaces do ...
_TOLERANCE_SHARE = 0.4
#: ... and by this many pixels in any case.
_TOLERANCE_PX = 8.0
#: OpenCV's number of a single k-d tree that is searched exactly.
_EXACT_KD_TREE = 4


def neighbour_agreement(keypoints0_xy: Array, keypoints1_xy: Array) -> Array:
    """Share of the nearest matches in the first image that move like each match, ``(N,)`` in [0, 1].

    Args:
        keypoints0_xy: ``(N, 2)`` pixels, finite.
        keypoints1_xy: ``(N, 2)`` pixels, matched row by row.
    """
    count = min(_NEIGHBOURS, len(keypoints0_xy) - 1)
    if count < 1:
        return np.ones(len(keypoints0_xy))
    places = np.ascontiguousarray(keypoints0_xy, dtype=np.float32)
    index = cv2.flann.Index(places, {"algorithm": _EXACT_KD_TREE})
    rows, square = index.knnSearch(places, count + 1, params={"checks": -1})
    # Of matches at one place any may come first, not always itself.
    is_other = rows != np.arange(len(places))[:, None]
    moves = keypoints1_xy - keypoints0_xy
    difference = np.linalg.norm(moves[rows] - moves[:, None], axis=2)
    alike = difference < _TOLERANCE_SHARE * np.sqrt(np.maximum(square, 0.0)) + _TOLERANCE_PX
    return np.asarray((alike & is_other).sum(axis=1) / np.maximum(is_other.sum(axis=1), 1), dtype=np.float64)
