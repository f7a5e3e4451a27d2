"""How far off the place of a submap is that was guessed, for whatever the camera sees from there.

Poses of such a submap are known well against each other, and against the rest of the map no better than the
guess: its first camera may be elsewhere and turned, and all lengths in it longer or shorter. What that does
to a pose grows with the way from there.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import skew

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GuessedPlace:
    """What a guess is worth.

    Attributes:
        frame_id: Keyframe that was placed.
        covariance: ``(7, 7)`` of a similarity in that camera's frame: turn in radians, place in map units,
            logarithm of the scale. None where nothing tells: the submap may be anywhere.
    """

    frame_id: int
    covariance: Array | None

    def seen_from(self, T_first_cam: Array) -> Array | None:
        """Return the covariance ``(7, 7)`` in the frame of another camera, ``T_first_cam (4, 4)``."""
        if self.covariance is None:
            return None
        return carried(self.covariance, T_first_cam)


def carried(covariance: Array, T_first_cam: Array) -> Array:
    """Covariance ``(7, 7)`` in a first camera's frame as one in that of a camera that moves with it."""
    adjoint = similarity_adjoint(T_first_cam)
    return np.asarray(adjoint @ covariance @ adjoint.T)


def similarity_adjoint(T_first_cam: Array) -> Array:
    """Matrix ``(7, 7)`` that carries a small similarity from a first camera's frame to another camera's."""
    R, t = T_first_cam[:3, :3], T_first_cam[:3, 3]
    adjoint = np.eye(7)
    adjoint[:3, :3] = adjoint[3:6, 3:6] = R.T
    adjoint[3:6, :3] = -R.T @ skew(t)
    adjoint[3:6, 6] = R.T @ t
    return adjoint


def guesses_as_arrays(guesses: Mapping[int, GuessedPlace]) -> dict[str, NDArray]:
    """Guesses by submap as plain arrays, for a checkpoint."""
    known = [g.covariance is not None for g in guesses.values()]
    covariances = [np.zeros((7, 7)) if g.covariance is None else g.covariance for g in guesses.values()]
    ids = [(submap, guess.frame_id) for submap, guess in guesses.items()]
    return {
        "guesses": np.array(ids, dtype=np.int64).reshape(-1, 2),
        "guesses.is_known": np.array(known, dtype=bool),
        "guesses.covariance": np.array(covariances, dtype=np.float64).reshape(-1, 7, 7),
    }


def guesses_of(arrays: Mapping[str, NDArray]) -> dict[int, GuessedPlace]:
    """Take what ``guesses_as_arrays`` gave, from the arrays of a map.

    Of an older checkpoint, which has none, every part but the first was guessed, and nothing tells how well.
    """
    if "guesses" not in arrays:
        frame_ids, submaps = arrays["poses.frame_id"], arrays["poses.submap"]
        later = np.unique(submaps)[1:].tolist()
        return {submap: GuessedPlace(int(frame_ids[submaps == submap].min()), None) for submap in later}
    rows = zip(
        arrays["guesses"].tolist(), arrays["guesses.is_known"], arrays["guesses.covariance"], strict=True
    )
    return {
        submap: GuessedPlace(frame_id, np.array(covariance) if known else None)
        for (submap, frame_id), known, covariance in rows
    }
