"""A drive through streets of houses, with corners, parked cars and traffic."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.motion import PACE_FACTOR, Pace, Wobble, look
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import Texture, asphalt, dead_leaves, facade, paint

Array = NDArray[np.float64]

#: Steps of the road's centre line, in metres.
STEP_M = 0.25
_LANE_M = 1.75
#: Where on the line the camera begins.
_START_M = 15
_EYE_M = 1.65


class Street:
    """Straight stretches and right-angled corners; the camera looks ahead from a car.

    Attributes:
        camera: 1024x320, 81 degrees wide, as cameras on cars have.
        rate_hz: Frames in a second.
        exposure_s: Time a frame is exposed for.
    """

    camera = Intrinsics(fx=600.0, fy=600.0, cx=511.5, cy=159.5, width=1024, height=320)
    rate_hz = 10.0
    exposure_s = 0.003
    #: How much more of the road than the camera needs is always in use.
    _ahead_of_camera_m = 0.0

    def __init__(self, seed: int, pace: Pace) -> None:
        """Build the streets and choose the speed."""
        rng = np.random.default_rng([seed, 3])
        bend, built = self._course(rng)
        self._line, self._yaw = _centre_line(bend)
        self._time_s = _timetable(bend, 9.0 * PACE_FACTOR[pace] ** 0.6)
        self._surfaces = _town(rng, self._line[:built], self._yaw[:built])
        self._cars = [_car_textures(rng) for _ in range(3)]
        self._ahead_m = rng.uniform(12, 25)
        self._oncoming_s = rng.uniform(3, 15, 2)
        self._sky = rng.uniform(150, 245, 3)
        self._bounce = Wobble.drawn(rng, 0.015, 0.8, 3.0)
        self._pitch = Wobble.drawn(rng, np.radians(0.25), 0.5, 3.0)
        self._roll = Wobble.drawn(rng, np.radians(0.2), 0.3, 2.0)

    def _course(self, rng: np.random.Generator) -> tuple[Array, int]:
        """Return the road's curvature every ``STEP_M``, smoothed, and how many of these steps to build on."""
        bends = [np.zeros(int(rng.uniform(45, 80) / STEP_M))]
        turn = rng.choice([-1.0, 1.0])
        for _ in range(7):
            radius = rng.uniform(9, 14)
            bends.append(np.full(int(radius * np.pi / 2 / STEP_M), turn / radius))
            bends.append(np.zeros(int(rng.uniform(40, 80) / STEP_M)))
            # Never round a block: the road would meet itself.
            turn = -turn
        bend = smoothed(np.concatenate(bends))
        return bend, len(bend)

    def _place(self, way_m: float) -> tuple[Array, float]:
        """Return position ``(x, y)`` and heading after a way along the line."""
        index = np.clip(way_m / STEP_M, 0, len(self._line) - 1.001)
        low, share = int(index), index - int(index)
        position = (1 - share) * self._line[low] + share * self._line[low + 1]
        return position, float((1 - share) * self._yaw[low] + share * self._yaw[low + 1])

    def in_lane(self, way_m: float, left_m: float = -_LANE_M) -> tuple[float, float, float]:
        """Return x, y and heading after a way along the line, in the camera's lane or elsewhere beside it."""
        (x, y), yaw = self._place(way_m)
        return x - left_m * np.sin(yaw), y + left_m * np.cos(yaw), yaw

    @property
    def lasts_s(self) -> float:
        """Time at which the camera, or what it is always behind, gets to the end of the road."""
        way_m = (len(self._line) - 2) * STEP_M - _START_M - self._ahead_of_camera_m
        return float(np.interp(way_m, np.arange(len(self._time_s)) * STEP_M, self._time_s))

    def camera_way_m(self, t_s: float) -> float:
        """Return how far along the line the camera is at a time."""
        return self._way_m(t_s) + _START_M

    def _way_m(self, t_s: float) -> float:
        return float(np.interp(t_s, self._time_s, np.arange(len(self._time_s)) * STEP_M))

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return the town, the car ahead and those that come towards the camera."""
        ways = [(self.camera_way_m(t_s) + self._ahead_m, -_LANE_M)]
        for meeting_s in self._oncoming_s:
            ways.append((self._way_m(meeting_s) - 8.0 * (t_s - meeting_s), _LANE_M))
        moving: list[Surface] = []
        for (way_m, left_m), painted in zip(ways, self._cars, strict=True):
            if 0 < way_m < (len(self._line) - 2) * STEP_M:
                moving += _car(*self.in_lane(way_m, left_m), painted)
        return [*self._surfaces, *moving]

    def T_world_cam(self, t_s: float) -> Array:
        """Return the camera's pose at a time."""
        x, y, yaw = self.in_lane(self.camera_way_m(t_s))
        position = np.array([x, y, _EYE_M + self._bounce.at(t_s)])
        return look(position, yaw, self._pitch.at(t_s), self._roll.at(t_s))

    def background(self) -> NDArray[np.float32]:
        """Return a sky that is brighter towards the horizon."""
        rows = np.linspace(0.9, 1.05, self.camera.height)[:, None, None]
        sky = np.clip(self._sky * rows, 0, 255)
        return np.broadcast_to(sky, (self.camera.height, self.camera.width, 3)).astype(np.float32)


def smoothed(bend: Array) -> Array:
    """Return curvatures that begin and end over a length, as cars drive."""
    kernel = np.ones(25) / 25
    return np.convolve(bend, kernel, mode="same")


def _centre_line(bend: Array) -> tuple[Array, Array]:
    """Return positions ``(N, 2)`` and headings of a line with these curvatures."""
    yaw = np.cumsum(bend) * STEP_M
    return np.cumsum(np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0) * STEP_M, yaw


def _timetable(bend: Array, speed_m_s: float) -> Array:
    """Return when each step of the line is reached, slower in corners and smoothly so."""
    speed = np.where(np.abs(bend) > 0.01, 0.55 * speed_m_s, speed_m_s)
    kernel = np.ones(61) / 61
    speed = np.convolve(np.pad(speed, 30, mode="edge"), kernel, mode="valid")
    return np.concatenate([[0.0], np.cumsum(STEP_M / speed)[:-1]])


def _town(rng: np.random.Generator, line: Array, yaw: Array) -> list[Surface]:
    low, high = line.min(0) - 60, line.max(0) + 60
    ground = asphalt(rng)
    found = [
        Surface(
            np.array([*low, 0.0]),
            np.array([high[0] - low[0], 0.0, 0.0]),
            np.array([0.0, high[1] - low[1], 0.0]),
            ground,
            ((high[0] - low[0]) / 8, (high[1] - low[1]) / 8),
        )
    ]
    normal = np.column_stack([-np.sin(yaw), np.cos(yaw)])
    fronts = [facade(rng) for _ in range(14)]
    leaves = [dead_leaves(rng, 0.8, max_radius_share=0.04) for _ in range(3)]
    wood, white = dead_leaves(rng, 0.3), paint(rng)
    cars = [_car_textures(rng) for _ in range(8)]
    for side in (-1, 1):
        kerb = line + side * 8.0 * normal
        index = 0
        while index < len(line) - 80:
            step = int(rng.uniform(9, 16) / STEP_M)
            near, far = kerb[index], kerb[min(index + step, len(line) - 1)]
            index += step + (int(rng.uniform(2, 10) / STEP_M) if rng.uniform() < 0.25 else 0)
            if np.linalg.norm(far - near) > 3:
                found += _house(rng, near, far, fronts, line)
        for place in range(20, len(line) - 40, int(rng.uniform(9, 14) / STEP_M)):
            position = line[place] + side * rng.uniform(5.0, 6.3) * normal[place]
            if _distance_m(position, line) < 4.5:
                continue
            if rng.uniform() < 0.45:
                crown = rng.uniform(1.6, 2.6)
                found += box((*position, 1.5), (0.3, 0.3, 3.0), yaw[place], [wood])
                found += box((*position, 2.6 + crown / 2), (crown,) * 3, rng.uniform(0, 3), leaves)
            else:
                found += box((*position, 2.5), (0.14, 0.14, 5.0), yaw[place], [white])
        for place in range(10, len(line) - 30, int(rng.uniform(7, 20) / STEP_M)):
            position = line[place] + side * 4.4 * normal[place]
            if rng.uniform() < 0.6 and _distance_m(position, line) > 4.0:
                found += _car(position[0], position[1], yaw[place], cars[rng.integers(len(cars))])
    for place in range(0, len(line) - 20, int(6 / STEP_M)):
        forward = np.array([np.cos(yaw[place]), np.sin(yaw[place]), 0.0])
        across = np.array([normal[place][0], normal[place][1], 0.0])
        corner = np.array([*line[place], 0.01]) - 0.07 * across
        found.append(Surface(corner, 2.5 * forward, 0.14 * across, white))
    return found


def _house(
    rng: np.random.Generator, near: Array, far: Array, fronts: list[Texture], line: Array
) -> list[Surface]:
    along = far - near
    length = float(np.linalg.norm(along))
    out = np.array([-along[1], along[0]]) / length
    middle = (near + far) / 2
    nearest = line[np.argmin(np.linalg.norm(line - middle, axis=1))]
    out = out * np.sign(out @ (middle - nearest))
    depth, tall = rng.uniform(7, 10), rng.uniform(6, 14)
    centre = middle + out * depth / 2
    if (
        min(
            _distance_m(centre + s * along / 2 + d * out * depth / 2, line)
            for s in (-1, 0, 1)
            for d in (-1, 1)
        )
        < 5
    ):
        return []
    chosen = [fronts[i] for i in rng.integers(len(fronts), size=4)]
    return box((*centre, tall / 2), (length, depth, tall), float(np.arctan2(along[1], along[0])), chosen)


def _distance_m(position: Array, line: Array) -> float:
    return float(np.linalg.norm(line - position, axis=1).min())


def _car_textures(rng: np.random.Generator) -> list[Texture]:
    return [paint(rng, 1.0), paint(rng, 1.0)]


def _car(x: float, y: float, yaw: float, painted: list[Texture]) -> list[Surface]:
    body = box((x, y, 0.6), (4.2, 1.75, 0.8), yaw, painted[:1])
    cabin = box((x, y, 1.25), (2.1, 1.6, 0.55), yaw, painted[1:])
    return body + cabin
