"""Motion prior: the camera goes on as it moved, for as long as that is known."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_so3, invert_transform, log_so3, make_transform
from semcast.server.geometry.gap_bridge import cross_gap, even_turns, hindcast, way_of
from semcast.server.geometry.jump import is_jump
from semcast.server.geometry.whereabouts import SAME_S, Step, Whereabouts, last_by, mean_way

Array = NDArray[np.float64]

#: A motion that was seen longer ago than this says nothing.
MAX_EXTRAPOLATION_S = 1.5
#: What came before and after a gap says nothing of one that is longer.
MAX_GAP_S = 3.0
#: The way from one pose to the next is mostly noise where poses are poor, as they are before a loss: a speed
#: is that of so long a time.
_SPEED_S = 1.0
#: Time for which steps are remembered, to tell how far the camera strays from where its speed leads.
_MEMORY_S = 8.0
#: A camera at rest is infinitely slower than one that moves: for a ratio of speeds, none is less than this
#: share of the highest.
_LEAST_SHARE_OF_SPEED = 0.02


class ConstantVelocity:
    """Predicts the next pose from the last two, scaled by their times.

    Attributes:
        times_mislead: Whether frames come in bunches whose times tell nothing of how far the camera went from
            one to the next: a speed is then that of a second, of turning too.
    """

    def __init__(self) -> None:
        self.times_mislead = False
        self._last: tuple[int, Array] | None = None
        self._rotation_rad_per_s: Array = np.zeros(3)
        self._translation_per_s: Array = np.zeros(3)
        self._steps: list[Step] = []

    @property
    def speed_map_per_s(self) -> float:
        """Length of the translation per second, over the last second."""
        return float(np.linalg.norm(self._way_per_s()))

    def speed_at(self, t_source_ns: int) -> tuple[float, float]:
        """Speed to expect at a time after the last pose, by the speeds of the last ``_MEMORY_S``.

        A robot keeps its speed, and its last one is the best guess. A hand that slowed down to turn goes on
        faster: between the last speed and the usual one is nearer the truth than either.

        Args:
            t_source_ns: Start of the second the speed is asked for.

        Returns:
            Map units per second, and the standard deviation of its logarithm: by what factor speeds so far
            apart differed so far; 0 where the motion is not known for so long.
        """
        ends_s, speeds = self._speeds()
        if self._last is None or len(speeds) == 0 or speeds.max() <= 0.0:
            return self.speed_map_per_s, 0.0
        ahead_s = max(0.0, (t_source_ns - self._last[0]) * 1e-9) + _SPEED_S
        logs = np.log(np.maximum(speeds, _LEAST_SHARE_OF_SPEED * speeds.max()))
        earlier = last_by(ends_s, ends_s - ahead_s)
        known = earlier >= 0
        if not known.any():
            return self.speed_map_per_s, 0.0
        changes = logs[known] - logs[earlier[known]]
        return float(np.exp(0.5 * (logs[-1] + logs.mean()))), float(np.sqrt(np.mean(changes**2)))

    def _speeds(self) -> tuple[Array, Array]:
        """Mean speeds ``(N,)`` over a second each, and the times ``(N,)`` in seconds at which these end."""
        t_s = np.cumsum([0.0, *(step_s for step_s, _, _ in self._steps)])
        ways = np.cumsum([np.zeros(3), *(way for _, _, way in self._steps)], axis=0)
        begin = last_by(t_s, t_s - _SPEED_S)
        known = begin >= 0
        begin = begin[known]
        lengths = np.linalg.norm(ways[known] - ways[begin], axis=1)
        return t_s[known], lengths / (t_s[known] - t_s[begin])

    def _way_per_s(self) -> Array:
        """Mean translation per second in the camera's own frame: turning does not shorten it, noise does."""
        return mean_way(self._steps, _SPEED_S)

    def _turn_per_s(self) -> Array:
        """Rotation vector per second in the camera's own frame, of the last step unless times mislead."""
        if not self.times_mislead:
            return self._rotation_rad_per_s
        return mean_way([(step_s, T, log_so3(T[:3, :3])) for step_s, T, _ in self._steps], _SPEED_S)

    def observe(self, t_source_ns: int, T_world_cam: Array) -> None:
        """Take the pose of a frame, in the map's unit.

        A frame not after the one before, but for rounding, or too long after it, tells no motion: the camera
        then rests.
        """
        if self._last is not None:
            t_ns, T_world_before = self._last
            elapsed_s = (t_source_ns - t_ns) * 1e-9
            if SAME_S < elapsed_s <= MAX_EXTRAPOLATION_S:
                T_before_now = invert_transform(T_world_before) @ T_world_cam
                turn = log_so3(T_before_now[:3, :3])
                self._rotation_rad_per_s = turn / elapsed_s
                self._translation_per_s = T_before_now[:3, 3] / elapsed_s
                # The way of a whole interval is in the frame in which that began: the camera turned on it.
                self._steps.append((elapsed_s, T_before_now, exp_so3(-0.5 * turn) @ T_before_now[:3, 3]))
                while sum(step_s for step_s, _, _ in self._steps[1:]) >= _MEMORY_S:
                    del self._steps[0]
            else:
                self._rotation_rad_per_s, self._translation_per_s = np.zeros(3), np.zeros(3)
                self._steps = []
        self._last = (t_source_ns, T_world_cam.copy())

    def correct(self, T_world_cam: Array, scale: float = 1.0) -> None:
        """Replace the last pose after the map has moved; the motion in the camera's frame stays."""
        if self._last is not None:
            self._last = (self._last[0], T_world_cam.copy())
            self._translation_per_s = self._translation_per_s * scale
            if scale != 1.0:
                self._steps = [
                    (step_s, make_transform(T[:3, :3], scale * T[:3, 3]), scale * way)
                    for step_s, T, way in self._steps
                ]

    def predict(self, t_source_ns: int) -> Array | None:
        """``T_world_cam`` expected at a time, None without any pose.

        The motion goes on for ``MAX_EXTRAPOLATION_S`` and ends there; before the last pose it is that one.
        """
        if self._last is None:
            return None
        t_ns, T_world_last = self._last
        elapsed_s = float(np.clip((t_source_ns - t_ns) * 1e-9, 0.0, MAX_EXTRAPOLATION_S))
        R = exp_so3(self._rotation_rad_per_s * elapsed_s)
        return np.asarray(T_world_last @ make_transform(R, self._translation_per_s * elapsed_s))

    def way_in(self, elapsed_s: float) -> Array:
        """Translation ``(3,)`` in the camera's own frame that goes on for so long."""
        return elapsed_s * self._way_per_s()

    def turn_in(self, elapsed_s: float) -> Array:
        """Rotation ``R_now_then (3, 3)`` of a camera that goes on turning as it did for so long."""
        return exp_so3(elapsed_s * self._turn_per_s())

    def jumps_to(self, t_source_ns: int, T_world_cam: Array) -> bool:
        """Tell whether a pose at a time is a jump of a camera that went steadily, see ``is_jump``."""
        if self._last is None:
            return False
        t_ns, T_world_last = self._last
        elapsed_s = (t_source_ns - t_ns) * 1e-9
        return elapsed_s > 0.0 and is_jump(
            self._steps, elapsed_s, invert_transform(T_world_last) @ T_world_cam
        )

    def whereabouts(self, t_source_ns: int, depth: float) -> Whereabouts | None:
        """Where the camera can be at a time, with the scene at a depth in map units.

        Returns:
            None without any pose, or with the last one more than ``MAX_GAP_S`` ago: it may be anywhere.
        """
        if self._last is None:
            return None
        t_ns, T_world_last = self._last
        elapsed_s = (t_source_ns - t_ns) * 1e-9
        if not 0.0 < elapsed_s <= MAX_GAP_S:
            return None
        return Whereabouts.after(T_world_last, elapsed_s, self._steps, depth)

    def bridge(
        self, t_source_ns: int, T_after_later: Array, later_s: float, turned: Sequence[tuple[int, Array]] = ()
    ) -> Array | None:
        """``T_world_cam`` at a time, where it is known how the camera moved from then on.

        How it turns and moves, in its own frame, changes evenly from what it was to what it will be: who
        drives into a bend out of sight does not come out of it straight on.

        Args:
            t_source_ns: The time.
            T_after_later: ``(4, 4)`` motion from then on.
            later_s: In so many seconds, more than 0.
            turned: Times ``t_ns`` and how the camera had turned by then, ``R_last_then (3, 3)``, ascending
                from the last pose to the time that is asked for; else turning is not known.

        Returns:
            The pose, or None without any pose, or with the last one too long ago.
        """
        if self._last is None:
            return None
        t_ns, T_world_cam = self._last
        gap_s = (t_source_ns - t_ns) * 1e-9
        if not 0.0 < gap_s <= MAX_GAP_S:
            return None
        turn_later = log_so3(T_after_later[:3, :3])
        way_later = way_of(T_after_later, turn_later)
        gap = np.asarray(gap_s)
        if turned and (turned[0][0], turned[-1][0]) == (t_ns, t_source_ns):
            ends = np.array([then_ns - t_ns for then_ns, _ in turned]) * 1e-9 / gap_s
            turns = np.stack([log_so3(before.T @ after) for (_, before), (_, after) in pairwise(turned)])
        else:
            ends, turns = even_turns(gap, self._turn_per_s(), turn_later / later_s)
        return cross_gap(T_world_cam, gap, (self._way_per_s(), way_later / later_s), ends, turns)

    def bridge_variances(self, t_source_ns: int, later_s: float) -> tuple[float, float] | None:
        """How far off ``bridge`` is, as it would have been in the camera's past: see ``hindcast``.

        What images tell of turning is not counted on: none were asked for then.
        """
        if self._last is None:
            return None
        return hindcast(self._steps, (t_source_ns - self._last[0]) * 1e-9, later_s, _SPEED_S)
