"""Tracks on something large that moves by itself, such as a lorry ahead, once there is a map.

Keyframes refute tracks that no point at rest explains (``new_landmarks``). Where they are many, two things
would go wrong without more care: tracks that have just begun beside them would hold the camera's rotation,
and become landmarks by chance, as nothing refutes them yet; and a lorry that stays where it is in the image
would make the camera seem to stand still, and keyframes be left out.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.world_map import Keyframe

Ids = NDArray[np.int64]

#: Refuted tracks that are taken for something large, at least: single ones have slipped.
_MIN_REFUTED = 30
#: The same as a share of all tracks of the keyframe.
_MIN_SHARE = 0.2
#: Nearest judged neighbours by which it is decided whether a track is on something large.
_NUM_NEIGHBOURS = 5
#: Of those, how many must be refuted.
_MIN_NUM_REFUTED = 4
#: How far away they may be, as a share of the image's width.
_MAX_DISTANCE_SHARE = 0.04


def on_something_large(keyframe: Keyframe) -> Ids:
    """Return the refuted tracks of a keyframe where they are many, else none."""
    is_large = len(keyframe.refuted) >= max(_MIN_REFUTED, _MIN_SHARE * len(keyframe.ids))
    return keyframe.refuted if is_large else np.zeros(0, np.int64)


def with_neighbours(keyframe: Keyframe, is_landmark: NDArray[np.bool_], width_px: int) -> Ids:
    """Return the refuted tracks of a keyframe with those that are on the same large thing.

    Its tracks come and go like all others, and the young ones have not been seen often enough to be refuted.
    They are told by their neighbours: landmarks, or refuted as well.

    Args:
        keyframe: With the tracks that it refutes by itself.
        is_landmark: ``(M,)`` which of its tracks are landmarks.
        width_px: Of the image.

    Returns:
        Ids, ascending; the refuted ones alone where these are few.
    """
    is_refuted = np.isin(keyframe.ids, on_something_large(keyframe))
    judged, young = np.flatnonzero(is_refuted | is_landmark), np.flatnonzero(~is_refuted & ~is_landmark)
    if not is_refuted.any() or len(judged) < _NUM_NEIGHBOURS:
        return keyframe.refuted
    distance_px = np.linalg.norm(keyframe.xy[young][:, None] - keyframe.xy[judged][None], axis=2)
    nearest = np.argpartition(distance_px, _NUM_NEIGHBOURS - 1, axis=1)[:, :_NUM_NEIGHBOURS]
    is_near = np.take_along_axis(distance_px, nearest, axis=1) < _MAX_DISTANCE_SHARE * width_px
    num_refuted = (is_refuted[judged[nearest]] & is_near).sum(axis=1)
    beside = keyframe.ids[young[num_refuted >= _MIN_NUM_REFUTED]]
    return np.union1d(keyframe.refuted, beside)
