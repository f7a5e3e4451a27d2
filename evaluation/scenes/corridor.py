"""A ring of corridors with bare walls, and a small robot that drives round it."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.motion import PACE_FACTOR, Pace, Wobble, look
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import Texture, asphalt, dead_leaves, paint

Array = NDArray[np.float64]

#: Outer side of the ring, width and height of a corridor, radius of the robot's turns.
_SIDE_M, _WIDTH_M, _HEIGHT_M, _TURN_M = 15.0, 2.2, 2.6, 0.9
_EYE_M = 0.45


class Corridor:
    """Plain walls with doors and a few posters, a floor of low contrast: little to hold on to.

    Attributes:
        camera: 640x480, 67 degrees wide, a little upwards.
        rate_hz: Frames in a second.
        exposure_s: Time a frame is exposed for.
    """

    camera = Intrinsics(fx=480.0, fy=480.0, cx=319.5, cy=239.5, width=640, height=480)
    rate_hz = 15.0
    exposure_s = 0.008

    def __init__(self, seed: int, pace: Pace) -> None:
        """Build the corridors and choose where to begin."""
        rng = np.random.default_rng([seed, 6])
        self._surfaces = _built(rng)
        self._speed_m_s = 0.8 * PACE_FACTOR[pace]
        self._start_m = rng.uniform(0.5, 2.0)
        shake_rad = np.radians(0.25) * PACE_FACTOR[pace]
        self._shake = [Wobble.drawn(rng, shake_rad, 0.5, 4.0) for _ in range(3)]

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return what there is to see; nothing moves."""
        return self._surfaces

    def T_world_cam(self, t_s: float) -> Array:
        """Return the camera's pose at a time."""
        x, y, heading = _on_course(self._start_m + self._speed_m_s * t_s)
        shake = [wobble.at(t_s) for wobble in self._shake]
        position = np.array([x, y, _EYE_M])
        return look(position, heading + shake[0], np.radians(6.0) + shake[1], shake[2])

    def background(self) -> NDArray[np.float32]:
        """Return darkness: walls hide all of it."""
        return np.zeros((self.camera.height, self.camera.width, 3), np.float32)


def _on_course(way_m: float) -> tuple[float, float, float]:
    """Return x, y and heading after a way: round the ring to the left, along the middle of the corridors."""
    middle = _SIDE_M / 2 - _WIDTH_M / 2
    straight, turn = 2 * (middle - _TURN_M), _TURN_M * np.pi / 2
    leg, rest = divmod(way_m, straight + turn)
    along, left, angle = rest - straight / 2, 0.0, 0.0
    if rest > straight:
        angle = (rest - straight) / _TURN_M
        along = straight / 2 + _TURN_M * np.sin(angle)
        left = _TURN_M * (1 - np.cos(angle))
    heading = leg * np.pi / 2
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = along, left - middle
    return cos * x - sin * y, sin * x + cos * y, heading + angle


def _built(rng: np.random.Generator) -> list[Surface]:
    walls, doors = [paint(rng, 3.0) for _ in range(2)], [paint(rng) for _ in range(3)]
    posters = [dead_leaves(rng, rng.uniform(0.5, 1.0)) for _ in range(8)]
    boxes = [dead_leaves(rng, 0.6) for _ in range(3)]
    half, inner = _SIDE_M / 2, _SIDE_M / 2 - _WIDTH_M
    across = np.diag([_SIDE_M, _SIDE_M, _HEIGHT_M])
    corner = np.array([-half, -half, 0.0])
    tiles = (_SIDE_M / 2, _SIDE_M / 2)
    found = [
        Surface(corner, across[0], across[1], asphalt(rng), tiles),
        Surface(corner + across[2], across[0], across[1], paint(rng, 2.0), tiles, 0.9),
    ]
    for leg in range(4):
        cos, sin = np.cos(leg * np.pi / 2), np.sin(leg * np.pi / 2)
        along, inward = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])
        outside = -half * along - half * inward
        found += _wall(rng, outside, _SIDE_M, along, inward, walls, doors, posters)
        inside = -inner * along - inner * inward
        found += _wall(rng, inside, 2 * inner, along, -inward, walls, doors, posters)
        for place in np.arange(-inner, inner, 2.0):
            lamp = place * along - (half - _WIDTH_M / 2) * inward + np.array([0, 0, _HEIGHT_M - 0.02])
            found.append(Surface(lamp, along, 0.2 * inward, walls[1], light=1.3))
        for place in rng.uniform(-inner, inner, 2):
            foot = place * along - (half - rng.choice([0.3, _WIDTH_M - 0.3])) * inward
            found += box((foot[0], foot[1], 0.4), (0.4, 0.3, 0.8), leg * np.pi / 2, boxes)
    return found


def _wall(
    rng: np.random.Generator,
    corner: Array,
    length_m: float,
    along: Array,
    inward: Array,
    walls: list[Texture],
    doors: list[Texture],
    posters: list[Texture],
) -> list[Surface]:
    up = np.array([0.0, 0.0, 1.0])
    light = rng.uniform(0.8, 1.0)
    found = [
        Surface(
            corner + _HEIGHT_M * up, length_m * along, -_HEIGHT_M * up, walls[0], (length_m / 3, 1.0), light
        )
    ]
    place = 0.6
    while place < length_m - 1.4:
        kind, here = rng.uniform(), corner + place * along
        if kind < 0.45:
            door, handle = here + 0.02 * inward + 2.05 * up, here + 0.1 * along + 0.05 * inward + 1.05 * up
            found.append(Surface(door, 0.9 * along, -2.05 * up, doors[rng.integers(3)]))
            found.append(Surface(handle, 0.12 * along, -0.05 * up, walls[1], light=0.4))
            place += rng.uniform(1.6, 3.0)
        elif kind < 0.8:
            wide, tall = rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.7)
            top = here + 0.01 * inward + rng.uniform(1.3, 1.9) * up
            found.append(Surface(top, wide * along, -tall * up, posters[rng.integers(8)]))
            place += wide + rng.uniform(0.4, 2.0)
        else:
            place += rng.uniform(0.5, 2.0)
    return found
