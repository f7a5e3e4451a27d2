"""Motion prior: the camera goes on as it moved, for as long as that is known."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_so3, invert_transform, log_so3, make_transform

Array = NDArray[np.float64]

#: A motion that was seen longer ago than this says nothing.
MAX_EXTRAPOLATION_S = 1.5
#: What came before and after a gap says nothing of one that is longer.
MAX_GAP_S = 3.0
#: Parts of a gap in which the motion is taken to be steady.
_BRIDGE_STEPS = 10


class ConstantVelocity:
    """Predicts the next pose from the last two, scaled by their times."""

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None
        self._rotation_rad_per_s: Array = np.zeros(3)
        self._translation_per_s: Array = np.zeros(3)
        self._interval_s = 0.0

    def reset(self) -> None:
        """Forget the motion."""
        self.__init__()  # type: ignore[misc]

    @property
    def speed_map_per_s(self) -> float:
        """Length of the translation per second."""
        return float(np.linalg.norm(self._translation_per_s))

    def observe(self, t_source_ns: int, T_world_cam: Array) -> None:
        """Take the pose of a frame, in the map's unit.

        A frame not after the one before, or too long after it, tells no motion: the camera then rests.
        """
        if self._last is not None:
            t_ns, T_world_before = self._last
            elapsed_s = (t_source_ns - t_ns) * 1e-9
            if 0.0 < elapsed_s <= MAX_EXTRAPOLATION_S:
                T_before_now = invert_transform(T_world_before) @ T_world_cam
                self._rotation_rad_per_s = log_so3(T_before_now[:3, :3]) / elapsed_s
                self._translation_per_s = T_before_now[:3, 3] / elapsed_s
                self._interval_s = elapsed_s
            else:
                self._rotation_rad_per_s, self._translation_per_s = np.zeros(3), np.zeros(3)
        self._last = (t_source_ns, T_world_cam.copy())

    def correct(self, T_world_cam: Array, scale: float = 1.0) -> None:
        """Replace the last pose after the map has moved; the motion in the camera's frame stays."""
        if self._last is not None:
            self._last = (self._last[0], T_world_cam.copy())
            self._translation_per_s = self._translation_per_s * scale

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

    def bridge(self, t_source_ns: int, T_after_later: Array, later_s: float) -> Array | None:
        """``T_world_cam`` at a time, where it is known how the camera moved from then on.

        How it turns and moves, in its own frame, changes evenly from what it was to what it will be: who
        drives into a bend out of sight does not come out of it straight on.

        Args:
            t_source_ns: The time.
            T_after_later: ``(4, 4)`` motion from then on.
            later_s: In so many seconds, more than 0.

        Returns:
            The pose, or None without any pose, or with the last one too long ago.
        """
        if self._last is None:
            return None
        t_ns, T_world_cam = self._last
        gap_s = (t_source_ns - t_ns) * 1e-9
        if not 0.0 < gap_s <= MAX_GAP_S:
            return None
        turn = np.stack([self._rotation_rad_per_s, log_so3(T_after_later[:3, :3]) / later_s])
        way = np.stack([self._translation_per_s, T_after_later[:3, 3] / later_s])
        # A way is that of a whole interval, in the frame in which that began: the camera turned on it.
        for k, interval_s in enumerate((self._interval_s, later_s)):
            way[k] = exp_so3(-0.5 * interval_s * turn[k]) @ way[k]
        step_s = gap_s / _BRIDGE_STEPS
        for share in (np.arange(_BRIDGE_STEPS) + 0.5) / _BRIDGE_STEPS:
            half = exp_so3(0.5 * step_s * ((1.0 - share) * turn[0] + share * turn[1]))
            step = make_transform(half, half @ (step_s * ((1.0 - share) * way[0] + share * way[1])))
            T_world_cam = T_world_cam @ step @ make_transform(half, np.zeros(3))
        return np.asarray(T_world_cam)
