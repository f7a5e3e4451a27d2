"""Motion prior: the camera goes on as it moved, for as long as that is known."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_so3, invert_transform, log_so3, make_transform

Array = NDArray[np.float64]

#: A motion that was seen longer ago than this says nothing.
MAX_EXTRAPOLATION_S = 1.5


class ConstantVelocity:
    """Predicts the next pose from the last two, scaled by their times."""

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None
        self._rotation_rad_per_s: Array = np.zeros(3)
        self._translation_per_s: Array = np.zeros(3)

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
