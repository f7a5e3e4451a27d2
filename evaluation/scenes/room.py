"""A furnished room through a handheld camera."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.motion import PACE_FACTOR, Pace, Wobble, look
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import Texture, dead_leaves, paint

Array = NDArray[np.float64]

_LENGTH_M, _WIDTH_M, _HEIGHT_M = 6.0, 5.0, 2.7


class Room:
    """Walls with pictures, furniture along them and on the floor, a camera that wanders and looks round.

    Attributes:
        camera: 640x480, 62 degrees wide.
        rate_hz: Frames in a second.
        exposure_s: Time a frame is exposed for.
        size_m: Length, width and height.
        stream: Which random numbers of a seed are drawn.
    """

    camera = Intrinsics(fx=530.0, fy=530.0, cx=319.5, cy=239.5, width=640, height=480)
    rate_hz = 30.0
    exposure_s = 0.008
    size_m = (_LENGTH_M, _WIDTH_M, _HEIGHT_M)
    stream = 1

    def __init__(self, seed: int, pace: Pace) -> None:
        """Furnish the room and choose the path."""
        rng = np.random.default_rng([seed, self.stream])
        self._surfaces = self.furnished(rng)
        factor = PACE_FACTOR[pace]
        self._away = [Wobble.drawn(rng, sd, 0.03 * factor, 0.12 * factor) for sd in (0.8, 0.6, 0.12)]
        self._start_yaw = rng.uniform(0, 2 * np.pi)
        self._turn_rad_s = np.radians(12.0) * factor * rng.choice([-1, 1])
        self._scan = Wobble.drawn(rng, 0.5, 0.03 * factor, 0.15 * factor)
        self._nod = Wobble.drawn(rng, 0.12, 0.05 * factor, 0.2 * factor)
        shake_rad = np.radians(0.35) * factor
        self._shake = [Wobble.drawn(rng, shake_rad, 0.8, 5.0) for _ in range(3)]
        self._tremor = [Wobble.drawn(rng, 0.004 * factor, 0.8, 5.0) for _ in range(3)]

    @staticmethod
    def furnished(rng: np.random.Generator) -> list[Surface]:
        """Return walls and furniture."""
        painted = [paint(rng) for _ in range(4)]
        walls = walls_of([*painted, dead_leaves(rng, 0.25, max_radius_share=0.06), paint(rng)], (2.0, 2.0))
        found = list(walls)
        for wall in walls[:4]:
            inward = np.cross(wall.edge_u_m, wall.edge_v_m)
            inward *= np.sign(inward @ (np.array(Room.size_m) / 2 - wall.corner_m))
            inward /= np.linalg.norm(inward)
            span = np.linalg.norm(wall.edge_u_m)
            along = wall.edge_u_m / span
            for place in np.arange(0.4, span - 0.9, rng.uniform(1.1, 1.7)):
                wide, tall = rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.8)
                top = wall.corner_m + along * place + np.array([0, 0, -rng.uniform(0.5, 0.9)]) + 0.02 * inward
                found.append(Surface(top, along * wide, np.array([0, 0, -tall]), dead_leaves(rng)))
            for place in np.arange(0.5, span - 0.5, rng.uniform(1.2, 2.0)):
                size = rng.uniform(0.4, 1.0), rng.uniform(0.3, 0.5), rng.uniform(0.4, 1.3)
                foot = wall.corner_m * (1, 1, 0) + along * place + inward * (size[1] / 2 + 0.05)
                yaw = np.arctan2(along[1], along[0]) + rng.normal(0, 0.1)
                contrast = rng.uniform(0.3, 0.9)
                sides = [dead_leaves(rng, contrast) for _ in range(2)]
                found += box((foot[0], foot[1], size[2] / 2), size, yaw, sides)
        return found

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return what there is to see; nothing moves."""
        return self._surfaces

    def T_world_cam(self, t_s: float) -> Array:
        """Return the camera's pose at a time."""
        middle = np.array([_LENGTH_M / 2, _WIDTH_M / 2, 1.4])
        away = np.array([w.at(t_s) + t.at(t_s) for w, t in zip(self._away, self._tremor, strict=True)])
        position = middle + np.clip(away, (-1.7, -1.3, -0.35), (1.7, 1.3, 0.35))
        yaw = self._start_yaw + self._turn_rad_s * t_s + self._scan.at(t_s) + self._shake[0].at(t_s)
        return look(position, yaw, -0.12 + self._nod.at(t_s) + self._shake[1].at(t_s), self._shake[2].at(t_s))

    def background(self) -> NDArray[np.float32]:
        """Return darkness: walls hide all of it."""
        return np.zeros((self.camera.height, self.camera.width, 3), np.float32)


def walls_of(
    textures: Sequence[Texture],
    carpet_repeats: tuple[float, float],
    size_m: tuple[float, float, float] = Room.size_m,
) -> list[Surface]:
    """Return four walls, the floor and the ceiling.

    Args:
        textures: Of these, in that order.
        carpet_repeats: How often the floor's fits along the room and across.
        size_m: Length, width and height.
    """
    length, width, height = np.diag(size_m)
    corner = np.zeros(3)
    return [
        Surface(corner + height, length, -height, textures[0], light=0.95),
        Surface(corner + width + height, length, -height, textures[1], light=0.8),
        Surface(corner + height, width, -height, textures[2], light=0.7),
        Surface(corner + length + height, width, -height, textures[3], light=1.05),
        Surface(corner, length, width, textures[4], carpet_repeats, 0.9),
        Surface(corner + height, length, width, textures[5], light=1.1),
    ]
