"""A still life on a table, and a camera that goes round it."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.motion import PACE_FACTOR, Pace, Wobble, look
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import dead_leaves, paint

Array = NDArray[np.float64]


class Orbit:
    """Boxes of all sizes on a table top before a plain grey, seen from a circle of 1.5 m.

    Attributes:
        camera: 640x480, 53 degrees wide.
        rate_hz: Frames in a second; 3.6 degrees of the circle each at normal pace.
        exposure_s: Time a frame is exposed for.
    """

    camera = Intrinsics(fx=640.0, fy=640.0, cx=319.5, cy=239.5, width=640, height=480)
    rate_hz = 10.0
    exposure_s = 0.004

    def __init__(self, seed: int, pace: Pace) -> None:
        """Lay the table and choose the way round."""
        rng = np.random.default_rng([seed, 2])
        top = Surface(
            np.array([-0.5, -0.5, 0.0]),
            np.array([1.0, 0.0, 0.0]),
            np.array([0.0, 1.0, 0.0]),
            dead_leaves(rng, 0.35, max_radius_share=0.05),
        )
        self._surfaces = [top, *_still_life(rng)]
        self._grey = float(rng.uniform(60, 240))
        factor = PACE_FACTOR[pace]
        self._rate_rad_s = np.radians(36.0) * factor * rng.choice([-1, 1])
        self._start_rad = rng.uniform(0, 2 * np.pi)
        self._height = Wobble.drawn(rng, 0.12, 0.03, 0.12)
        self._distance = Wobble.drawn(rng, 0.08, 0.03, 0.12)
        self._shake = [Wobble.drawn(rng, np.radians(0.25) * factor, 0.5, 3.0) for _ in range(3)]

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return what there is to see; nothing moves."""
        return self._surfaces

    def T_world_cam(self, t_s: float) -> Array:
        """Return the camera's pose at a time."""
        angle = self._start_rad + self._rate_rad_s * t_s
        away = 1.5 + self._distance.at(t_s)
        position = np.array([away * np.cos(angle), away * np.sin(angle), 0.75 + self._height.at(t_s)])
        pitch = -np.arctan2(position[2] - 0.12, away)
        shake = [wobble.at(t_s) for wobble in self._shake]
        return look(position, angle + np.pi + shake[0], pitch + shake[1], shake[2])

    def background(self) -> NDArray[np.float32]:
        """Return the plain grey behind the table."""
        return np.full((self.camera.height, self.camera.width, 3), self._grey, np.float32)


def _still_life(rng: np.random.Generator) -> list[Surface]:
    found: list[Surface] = []
    for _ in range(9):
        x, y = rng.uniform(-0.32, 0.32, 2)
        size = rng.uniform(0.06, 0.2), rng.uniform(0.06, 0.2), rng.uniform(0.08, 0.4)
        painted = [
            dead_leaves(rng, rng.uniform(0.4, 1.0)) if rng.uniform() < 0.7 else paint(rng) for _ in range(3)
        ]
        found += box((x, y, size[2] / 2), size, rng.uniform(0, np.pi), painted)
    return found
