"""Fields and farms, and a drone that flies over them lane by lane and looks down."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.motion import PACE_FACTOR, Pace, Wobble, look
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import Texture, asphalt, dead_leaves, paint

Array = NDArray[np.float64]

#: Length of a lane, and half the distance of two, which is the radius of the turn between them.
_LANE_M, _TURN_M = 90.0, 11.0
#: Twelve lanes, as far as the longest recording gets, begin at the lower edge of the land.
_SIDE_M, _FIRST_LANE_M = 416.0, -180.0
_FIELD_M, _TRACK_M = 32.0, 4.0


class Survey:
    """Almost flat ground from 35 to 55 m above: fields, tracks, low buildings, trees.

    Attributes:
        camera: 640x480, 67 degrees wide.
        rate_hz: Frames in a second.
        exposure_s: Time a frame is exposed for.
    """

    camera = Intrinsics(fx=480.0, fy=480.0, cx=319.5, cy=239.5, width=640, height=480)
    rate_hz = 10.0
    exposure_s = 0.002

    def __init__(self, seed: int, pace: Pace) -> None:
        """Lay out the land and choose speed and height."""
        rng = np.random.default_rng([seed, 5])
        self._surfaces = _land(rng)
        self._speed_m_s = 8.0 * PACE_FACTOR[pace] ** 0.6
        self._height_m = rng.uniform(35, 55)
        self._start_m = rng.uniform(0.0, 0.5 * _LANE_M)
        self._pitch_rad = np.radians(rng.uniform(-90, -80))
        self._sway = [Wobble.drawn(rng, sd, 0.05, 0.3) for sd in (0.6, 0.6, 0.8)]
        self._shake = [Wobble.drawn(rng, np.radians(1.0), 0.1, 1.5) for _ in range(3)]

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return what there is to see; nothing moves."""
        return self._surfaces

    def T_world_cam(self, t_s: float) -> Array:
        """Return the camera's pose at a time."""
        x, y, heading = _on_course(self._start_m + self._speed_m_s * t_s)
        sway = [wobble.at(t_s) for wobble in self._sway]
        position = np.array([x + sway[0], y + sway[1], self._height_m + sway[2]])
        shake = [wobble.at(t_s) for wobble in self._shake]
        return look(position, heading + shake[0], self._pitch_rad + shake[1], shake[2])

    def background(self) -> NDArray[np.float32]:
        """Return the haze beyond the land, of which the first lane shows a strip."""
        return np.full((self.camera.height, self.camera.width, 3), 190.0, np.float32)


def _on_course(way_m: float) -> tuple[float, float, float]:
    """Return x, y and heading after a way: lanes to and fro, joined by half circles."""
    turn = np.pi * _TURN_M
    lane, rest = divmod(way_m, _LANE_M + turn)
    side = 1.0 if lane % 2 == 0 else -1.0
    x0, y0 = -side * _LANE_M / 2, _FIRST_LANE_M + 2 * _TURN_M * lane
    if rest < _LANE_M:
        return x0 + side * rest, y0, 0.0 if side > 0 else np.pi
    angle = (rest - _LANE_M) / _TURN_M
    x = -x0 + side * _TURN_M * np.sin(angle)
    return x, y0 + _TURN_M * (1 - np.cos(angle)), angle if side > 0 else np.pi - angle


def _land(rng: np.random.Generator) -> list[Surface]:
    crops = [
        dead_leaves(rng, rng.uniform(0.15, 0.5), max_radius_share=rng.uniform(0.01, 0.06)) for _ in range(7)
    ]
    track, roofs = asphalt(rng), [dead_leaves(rng, 0.25, max_radius_share=0.03) for _ in range(3)]
    walls = [paint(rng) for _ in range(3)]
    crowns = [dead_leaves(rng, 0.7, max_radius_share=0.05) for _ in range(3)]
    found = _fields(rng, crops)
    for _ in range(2):
        place = rng.uniform(-190, 60)
        found.append(_strip(np.array([-_SIDE_M / 2, place]), np.array([_SIDE_M, 0.0]), track))
        place = rng.uniform(-60, 60)
        found.append(_strip(np.array([place, -_SIDE_M / 2]), np.array([0.0, _SIDE_M]), track))
    for _ in range(24):
        x, y = rng.uniform(-90, 90), rng.uniform(-205, 95)
        size = (rng.uniform(8, 18), rng.uniform(7, 12), rng.uniform(2.5, 8))
        painted = [*(walls[i] for i in rng.integers(3, size=4)), roofs[rng.integers(3)]]
        found += box((x, y, size[2] / 2), size, rng.uniform(0, np.pi), painted)
    for _ in range(100):
        x, y = rng.uniform(-110, 110), rng.uniform(-205, 95)
        crown = rng.uniform(2.5, 6)
        tall = crown * rng.uniform(0.8, 1.6)
        found += box((x, y, tall / 2), (crown, crown, tall), rng.uniform(0, 3), crowns)
    return found


def _fields(rng: np.random.Generator, crops: list[Texture]) -> list[Surface]:
    found = []
    for x in np.arange(-_SIDE_M / 2, _SIDE_M / 2, _FIELD_M):
        for y in np.arange(-_SIDE_M / 2, _SIDE_M / 2, _FIELD_M):
            # A texture covers its field once: crops differ from place to place.
            turned = rng.uniform() < 0.5
            along, across = np.array([_FIELD_M, 0.0, 0.0]), np.array([0.0, _FIELD_M, 0.0])
            edges = (across, along) if turned else (along, across)
            crop = crops[rng.integers(len(crops))]
            found.append(Surface(np.array([x, y, 0.0]), *edges, crop, light=rng.uniform(0.75, 1.2)))
    return found


def _strip(start_m: Array, way_m: Array, texture: Texture) -> Surface:
    length = float(np.linalg.norm(way_m))
    across = np.array([-way_m[1], way_m[0]]) * _TRACK_M / length
    corner, along = np.array([*start_m, 0.02]), np.array([*way_m, 0.0])
    return Surface(corner, along, np.array([*across, 0.0]), texture, (length / _TRACK_M, 1.0))
