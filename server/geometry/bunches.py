"""Frames that come in bunches, and whether their times tell how far the camera went between them.

On networks and busy hubs frames wait for each other and come several at once, and some sources give them the
time at which they came. By that, a camera stands still through a bunch and leaps to the next. Others do take
several images in a row and rest. Times alone look the same; how the camera moved tells which it is.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcast.common.geometry import exp_so3, log_so3, make_transform

Array = NDArray[np.float64]

#: An interval that is shorter than this share of the mean is within a bunch.
_BUNCH_SHARE = 1.0 / 3.0
#: One that is longer than this share of it is one that frames waited for.
_WAIT_SHARE = 1.5
#: So many steps tell whether times mislead, of several bunches of a few frames or two of many,
_NUM_STEPS = 24
#: which began after so many waits: after a single one, a camera that hung has gone on.
_LEAST_WAITS = 2


def in_bunches(intervals: ArrayLike) -> bool:
    """Tell whether any of these times between frames is within a bunch.

    Args:
        intervals: ``(N,)`` in any unit, each shared among the frames that are missing in it.
    """
    times = np.asarray(intervals, np.float64)
    return len(times) > 1 and bool(times.min() < _BUNCH_SHARE * times.mean())


class Bunches:
    """Remembers the last steps of a camera and the times they took."""

    def __init__(self) -> None:
        self._steps: list[tuple[float, Array]] = []
        self._mislead = False

    @property
    def mislead(self) -> bool:
        """Whether steps are alike and the times between frames are not: these tell no speed."""
        return self._mislead

    @property
    def last(self) -> Array | None:
        """The last step, ``T_before_now (4, 4)`` of one frame; None before there is one."""
        return self._steps[-1][1] if self._steps else None

    def note(self, elapsed_s: float, T_before_now: Array, num_frames: int = 1) -> None:
        """Take the step ``(4, 4)`` from one pose to another ``num_frames`` on, and how long it took.

        Frames that are missing in between count as steps of their own, all alike: regular frames around a
        gap come in no bunches.
        """
        turn, way = log_so3(T_before_now[:3, :3]) / num_frames, T_before_now[:3, 3] / num_frames
        step = (elapsed_s / num_frames, make_transform(exp_so3(turn), way))
        self._steps = [*self._steps[1 - _NUM_STEPS :], step]
        times = np.array([step_s for step_s, _ in self._steps])
        has_bunches = (
            in_bunches(times) and np.count_nonzero(times > _WAIT_SHARE * times.mean()) >= _LEAST_WAITS
        )
        self._mislead = bool(has_bunches) and self._are_alike()

    def rescale(self, scale: float) -> None:
        """Count ways in another unit, of which there are ``scale`` for one of the old."""
        self._steps = [(step_s, make_transform(T[:3, :3], scale * T[:3, 3])) for step_s, T in self._steps]

    def _are_alike(self) -> bool:
        """Whether steps are more like the ones before them than they would be at the same speed."""
        moves = [np.stack([T[:3, 3], log_so3(T[:3, :3])]) for _, T in self._steps]
        # Of ways and of turns, each counted in their own length.
        total = np.maximum(np.linalg.norm(moves, axis=2).sum(axis=0), 1e-12)
        longer = [
            max(after_s, 0.0) / max(before_s, 1e-9) for (before_s, _), (after_s, _) in pairwise(self._steps)
        ]
        at_speed = sum(
            np.linalg.norm(after - times * before, axis=1)
            for times, (before, after) in zip(longer, pairwise(moves), strict=True)
        )
        alike = sum(np.linalg.norm(after - before, axis=1) for before, after in pairwise(moves))
        return float((alike / total).sum()) < float((at_speed / total).sum())
