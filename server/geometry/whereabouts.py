"""Where a camera can have got to in a gap: no further from where its motion leads than it ever strayed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: A speed is told over so long a time.
_SPEED_S = 0.3
#: A camera may go astray by so many times what it did of late,
_TIMES_AS_FAR = 2.0
#: or by this share of the way: it stops, or goes on half as fast again,
_WAY_SHARE = 0.6
#: or by this share of the scene's depth: a camera that stood sets off.
_DEPTH_SHARE = 0.3
#: How far it went astray is told over these spans too, and grows from them with time as where a speed leads
#: that is a random walk.
_SPANS_S = (0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0)
_GROWTH = 1.5


@dataclass(frozen=True)
class Whereabouts:
    """A ball the camera is in.

    Attributes:
        centre: ``(3,)`` where its motion leads, world frame.
        radius: How far from there it may be, map units.
    """

    centre: Array
    radius: float

    @classmethod
    def after(
        cls,
        T_world_cam: Array,
        way: Array,
        elapsed_s: float,
        steps: Sequence[tuple[float, Array]],
        depth: float,
    ) -> "Whereabouts":
        """Tell where a camera can be some time after its last pose.

        Args:
            T_world_cam: ``(4, 4)`` the last pose.
            way: ``(3,)`` that it would go on at its speed, in its own frame.
            elapsed_s: Time since.
            steps: Seconds and ``T_before_now (4, 4)`` of its last steps, oldest first.
            depth: Of the scene, map units.
        """
        strayed = _strayed(steps, elapsed_s)
        radius = max(_TIMES_AS_FAR * strayed, _WAY_SHARE * float(np.linalg.norm(way)), _DEPTH_SHARE * depth)
        return cls(T_world_cam[:3, 3] + T_world_cam[:3, :3] @ way, radius)

    def holds(self, T_world_cam: Array) -> bool:
        """Whether a pose ``(4, 4)`` is in there."""
        return float(np.linalg.norm(T_world_cam[:3, 3] - self.centre)) <= self.radius


def _strayed(steps: Sequence[tuple[float, Array]], elapsed_s: float) -> float:
    """Return how far a camera goes from where its speed led in so long a time, as its last steps tell.

    A hand that has just begun to move fast has not yet had the time to go as far as it will: shorter spans
    tell what it can do.
    """
    if not steps:
        return 0.0
    T_first_cam = [np.eye(4)]
    for _, T_before_now in steps:
        T_first_cam.append(T_first_cam[-1] @ T_before_now)
    xyz = np.array(T_first_cam)[:, :3, 3]
    t_s = np.concatenate([[0.0], np.cumsum([step_s for step_s, _ in steps])])
    before = np.searchsorted(t_s, t_s - _SPEED_S + 1e-6, side="right") - 1
    known = np.flatnonzero(before >= 0)
    before = before[known]
    speed = np.zeros_like(xyz)
    speed[known] = (xyz[known] - xyz[before]) / (t_s[known] - t_s[before])[:, None]
    furthest = 0.0
    for span_s in [*(s for s in _SPANS_S if s < elapsed_s), elapsed_s]:
        after = np.searchsorted(t_s, t_s + span_s - 1e-6)
        now = known[after[known] < len(t_s)]
        after = after[now]
        strayed = xyz[after] - xyz[now] - speed[now] * (t_s[after] - t_s[now])[:, None]
        far = float(np.linalg.norm(strayed, axis=1).max(initial=0.0))
        furthest = max(furthest, far * (elapsed_s / span_s) ** _GROWTH)
    return furthest
