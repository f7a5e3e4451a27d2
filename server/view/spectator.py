"""Where the viewer's eye stands: behind and above the moving camera, following it smoothly."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import make_transform

Array = NDArray[np.float64]

#: Place of the eye and of what it looks at, in camera axes and median landmark distances.
EYE_OFFSET = np.array([-0.35, -0.55, -1.15])
TARGET_OFFSET = np.array([0.1, 0.1, 0.6])
#: Share of the way to its new place the eye goes with each frame.
FOLLOW_GAIN = 0.15


class Spectator:
    """Follows a camera without its shake: place and direction are low-pass filtered over frames."""

    def __init__(self) -> None:
        self._eye: Array | None = None
        self._target = np.zeros(3)
        self._down = np.zeros(3)

    def follow(self, T_world_cam: Array, scene_size: float) -> Array:
        """Return ``T_world_eye`` (4x4, camera axes) for the next frame.

        Args:
            T_world_cam: The camera's pose.
            scene_size: Median distance of landmarks in map units; 0 counts as 1.
        """
        size = scene_size if scene_size > 0 else 1.0
        R, centre = T_world_cam[:3, :3], T_world_cam[:3, 3]
        eye, target, down = centre + R @ (size * EYE_OFFSET), centre + R @ (size * TARGET_OFFSET), R[:, 1]
        gain = 1.0 if self._eye is None else FOLLOW_GAIN
        previous = self._eye if self._eye is not None else eye
        self._eye = previous + gain * (eye - previous)
        self._target = self._target + gain * (target - self._target)
        self._down = self._down + gain * (down - self._down)
        return look_at(self._eye, self._target, self._down)


def look_at(eye: Array, target: Array, down: Array) -> Array:
    """Return the pose of a camera at ``eye`` that looks at ``target`` with image rows along ``down``.

    Where the directions leave no choice (looking along ``down``, or at its own place) any valid rotation
    is returned.
    """
    forward = _unit(target - eye, np.array([0.0, 0.0, 1.0]))
    spare = np.eye(3)[int(np.argmin(np.abs(forward)))]
    right = _unit(np.cross(down, forward), _unit(np.cross(spare, forward), spare))
    return make_transform(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def _unit(v: Array, fallback: Array) -> Array:
    length = float(np.linalg.norm(v))
    return v / length if length > 1e-9 else fallback
