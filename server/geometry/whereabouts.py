"""Where a camera can have got to in a gap: no further from where its motion leads than it ever strayed.

Where it leads depends on how the camera turned meanwhile, and a pose that was found tells that.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_se3, logs_so3

Array = NDArray[np.float64]
#: Seconds, ``T_before_now (4, 4)`` and the way ``(3,)`` in the camera's own frame, which turning does not
#: shorten.
Step = tuple[float, Array, Array]

#: A speed is told over so long a time.
_SPEED_S = 0.5
#: A camera may go astray by so many times what it did of late,
_TIMES_AS_FAR = 1.25
#: or by this share of the way: it stops, or goes on half as fast again,
_WAY_SHARE = 0.6
#: or by this share of the scene's depth: a camera that stood sets off.
_DEPTH_SHARE = 0.3
#: How far it went astray is told over these spans too, and grows from them with time as where a speed leads
#: that is a random walk.
_SPANS_S = (0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0)
_GROWTH = 1.5
#: Sums of intervals that differ by less are the same time.
SAME_S = 1e-6


@dataclass(frozen=True)
class Whereabouts:
    """A ball the camera is in, which lies elsewhere for each turn it may have made.

    How a camera has turned shows in the image, one off in a row of equal things as well. It tells how much
    of a bend lies behind it: most of how far it can have gone astray.

    Attributes:
        T_world_last: ``(4, 4)`` its last pose.
        way: ``(3,)`` that it has gone since at its speed, in its own frame, map units.
        radius: How far it may be from where that leads, map units.
    """

    T_world_last: Array
    way: Array
    radius: float

    @classmethod
    def after(
        cls, T_world_last: Array, elapsed_s: float, steps: Sequence[Step], depth: float
    ) -> "Whereabouts":
        """Tell where a camera can be some time after its last pose.

        Args:
            T_world_last: ``(4, 4)`` the last pose.
            elapsed_s: Time since.
            steps: Its last ones, oldest first.
            depth: Of the scene, map units.
        """
        way = elapsed_s * mean_way(steps, _SPEED_S)
        strayed = _strayed(steps, elapsed_s)
        radius = max(_TIMES_AS_FAR * strayed, _WAY_SHARE * float(np.linalg.norm(way)), _DEPTH_SHARE * depth)
        return cls(T_world_last, way, radius)

    def turned_alike(self, T_world_cam: Array) -> Array:
        """Return the pose ``(4, 4)`` to which the motion leads a camera that turned as another pose did."""
        T_world_led = T_world_cam.copy()
        T_world_led[:3, 3] = _led(self.T_world_last, T_world_cam, self.way)[0]
        return T_world_led

    def astray(self, T_world_cam: Array) -> float:
        """Return how far a pose ``(4, 4)`` is from where the motion leads a camera that turned as it did."""
        return float(_astray(self.T_world_last, T_world_cam, self.way))

    def holds(self, T_world_cam: Array) -> bool:
        """Whether a pose ``(4, 4)`` is in there."""
        return self.astray(T_world_cam) <= self.radius


def mean_way(steps: Sequence[Step], span_s: float) -> Array:
    """Mean way ``(3,)`` per second of the newest steps that make up so long a time; of none it is zero."""
    total_s, total = 0.0, np.zeros(3)
    for step_s, _, way in reversed(steps):
        if total_s >= span_s - SAME_S:
            break
        total_s, total = total_s + step_s, total + way
    return total / total_s if total_s > 0.0 else total


def path_of(steps: Sequence[Step]) -> tuple[Array, Array, Array]:
    """Return what ``N`` steps add up to, one at least.

    Returns:
        Of where each of them begins, and the last one ends: seconds ``(N + 1,)`` since the first one began,
        ``T_first_cam (N + 1, 4, 4)``, and the way gone ``(N + 1, 3)``, the sum of the steps' own.
    """
    T_first_cam = np.array(list(accumulate((T for _, T, _ in steps), np.matmul, initial=np.eye(4))))
    gone = np.concatenate([np.zeros((1, 3)), np.cumsum([way for _, _, way in steps], axis=0)])
    t_s = np.concatenate([[0.0], np.cumsum([step_s for step_s, _, _ in steps])])
    return t_s, T_first_cam, gone


def last_by(ascending_s: Array, at_s: Array) -> NDArray[np.int64]:
    """Index of the last time that is not after another one, for each of these; -1 where there is none."""
    return np.searchsorted(ascending_s, at_s + SAME_S, side="right") - 1


def _led(T_world_before: Array, T_world_after: Array, way: Array) -> Array:
    """Return where ways ``(..., 3)`` lead from poses ``(..., 4, 4)`` cameras that end turned as others.

    Returns:
        ``(2, ..., 3)``: by a way that bends as the camera turned, evenly, and straight on by that of a camera
        that turned and its way did not.
    """
    turn = logs_so3(np.swapaxes(T_world_before[..., :3, :3], -1, -2) @ T_world_after[..., :3, :3])
    turns = np.stack([turn, np.zeros_like(turn)])
    twists = np.concatenate([turns, np.broadcast_to(way, turns.shape)], axis=-1)
    return np.asarray((T_world_before @ exp_se3(twists))[..., :3, 3])


def _astray(T_world_before: Array, T_world_after: Array, way: Array) -> Array:
    """Return how far poses ``(..., 4, 4)`` are from where ways lead, the nearer of both: ``(...)``."""
    led = _led(T_world_before, T_world_after, way)
    return np.asarray(np.linalg.norm(led - T_world_after[..., :3, 3], axis=-1).min(axis=0))


def _strayed(steps: Sequence[Step], elapsed_s: float) -> float:
    """Return how far a camera goes from where its speed led in so long a time, as its last steps tell.

    A hand that has just begun to move fast has not yet had the time to go as far as it will: shorter spans
    tell what it can do.
    """
    if not steps:
        return 0.0
    t_s, T_first_cam, gone = path_of(steps)
    before = last_by(t_s, t_s - _SPEED_S)
    known = np.flatnonzero(before >= 0)
    before = before[known]
    speed = np.zeros_like(gone)
    speed[known] = (gone[known] - gone[before]) / (t_s[known] - t_s[before])[:, None]
    furthest = 0.0
    for span_s in [*(s for s in _SPANS_S if s < elapsed_s), elapsed_s]:
        after = np.searchsorted(t_s, t_s + span_s - SAME_S)
        now = known[after[known] < len(t_s)]
        after = after[now]
        way = speed[now] * (t_s[after] - t_s[now])[:, None]
        far = _astray(T_first_cam[now], T_first_cam[after], way).max(initial=0.0)
        furthest = max(furthest, float(far) * (elapsed_s / span_s) ** _GROWTH)
    return furthest
