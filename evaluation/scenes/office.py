"""An office through a handheld camera that is carried round: desks, shelves, bare corners between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.evaluation.scenes.motion import look
from semcast.evaluation.scenes.room import Room, walls_of
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import Texture, dead_leaves, paint

Array = NDArray[np.float64]

#: Half axes of the way round, and how far outwards of it the camera looks.
_WAY_M, _OUTWARDS_RAD = np.array([2.4, 1.5]), np.radians(50.0)
#: Wall without furniture on both sides of a corner.
_BARE_M = 2.4
#: Fine grain of plain paint, below the noise of the camera.
_GRAIN = 0.5


class Office(Room):
    """Two long walls with desks, two short ones with a shelf of books, sockets and switches in corners.

    The camera is that of ``Room``, at half the frames a second. It goes round in 30 s at normal pace and
    looks ahead and outwards: at corners some second goes by from the last furniture to the next.
    """

    rate_hz = 15.0
    size_m = (9.0, 7.0, 2.7)
    stream = 9

    @staticmethod
    def furnished(rng: np.random.Generator) -> list[Surface]:
        """Return walls and furniture."""
        plain, carpet = paint(rng, _GRAIN), dead_leaves(rng, 0.2, max_radius_share=0.02)
        length, width, _ = Office.size_m
        found = walls_of([*[plain] * 4, carpet, plain], (length / 2, width / 2), Office.size_m)
        things = [dead_leaves(rng, rng.uniform(0.5, 1.0)) for _ in range(10)]
        spines = [paint(rng) for _ in range(12)]
        for quarters in range(4):
            wall = _Wall(quarters, width / 2 if quarters % 2 == 0 else length / 2)
            half_m = (length if quarters % 2 == 0 else width) / 2 - _BARE_M
            if quarters % 2 == 0:
                found += _desks(rng, wall, half_m, things)
            else:
                found += _shelf(rng, wall, half_m, spines)
            found += _trim(rng, wall, half_m + _BARE_M, spines)
        return found

    def T_world_cam(self, t_s: float) -> Array:
        """Return the camera's pose at a time."""
        angle, side = self._start_yaw + self._turn_rad_s * t_s, np.sign(self._turn_rad_s)
        cos, sin = np.cos(angle), np.sin(angle)
        away = np.array([w.at(t_s) for w in self._away]) * (0.2, 0.2, 1.0)
        middle = np.array([self.size_m[0] / 2, self.size_m[1] / 2, 1.5])
        position = middle + np.array([*_WAY_M * (cos, sin), 0.0]) + away + [w.at(t_s) for w in self._tremor]
        heading = np.arctan2(side * _WAY_M[1] * cos, -side * _WAY_M[0] * sin)
        yaw = heading - side * _OUTWARDS_RAD + 0.4 * self._scan.at(t_s) + self._shake[0].at(t_s)
        return look(position, yaw, -0.08 + self._nod.at(t_s) + self._shake[1].at(t_s), self._shake[2].at(t_s))


@dataclass(frozen=True)
class _Wall:
    """A wall to put things before.

    Attributes:
        quarters: Turns by a right angle that bring it from the side of lower y to its place.
        away_m: From the middle of the room.
    """

    quarters: int
    away_m: float

    @property
    def yaw_rad(self) -> float:
        """Direction along it."""
        return self.quarters * np.pi / 2

    def at(self, along_m: float, before_m: float, height_m: float) -> tuple[float, float, float]:
        """Return the place so far from its middle, before it and above the floor."""
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        x, y = along_m, before_m - self.away_m
        return Office.size_m[0] / 2 + cos * x - sin * y, Office.size_m[1] / 2 + sin * x + cos * y, height_m


def _desks(rng: np.random.Generator, wall: _Wall, half_m: float, things: list[Texture]) -> list[Surface]:
    """Return desks side by side, each with a screen and small things, and pictures above."""
    wood, dark = paint(rng), paint(rng)
    found = []
    for left in np.arange(-half_m, half_m - 1.3, 1.45):
        middle = left + 0.7
        found += box(wall.at(middle, 0.4, 0.72), (1.4, 0.75, 0.03), wall.yaw_rad, [wood])
        for end in (-0.65, 0.65):
            found += box(wall.at(middle + end, 0.4, 0.35), (0.04, 0.7, 0.7), wall.yaw_rad, [wood])
        place = middle + rng.uniform(-0.3, 0.3)
        shown = things[rng.integers(len(things))]
        yaw = wall.yaw_rad + rng.normal(0, 0.15)
        found += box(wall.at(place, 0.25, 1.05), (0.55, 0.04, 0.34), yaw, [shown, dark, dark, dark])
        found += box(wall.at(place, 0.22, 0.81), (0.06, 0.06, 0.16), yaw, [dark])
        for _ in range(5):
            size = rng.uniform(0.08, 0.3), rng.uniform(0.06, 0.2), rng.uniform(0.02, 0.2)
            spot = wall.at(middle + rng.uniform(-0.6, 0.6), rng.uniform(0.4, 0.65), 0.735 + size[2] / 2)
            found += box(spot, size, rng.uniform(0, np.pi), [things[rng.integers(len(things))]])
        size = rng.uniform(0.35, 0.8), 0.02, rng.uniform(0.3, 0.6)
        spot = wall.at(middle + rng.uniform(-0.3, 0.3), 0.01, rng.uniform(1.6, 1.9))
        found += box(spot, size, wall.yaw_rad, [things[rng.integers(len(things))]])
    return found


def _shelf(rng: np.random.Generator, wall: _Wall, half_m: float, spines: list[Texture]) -> list[Surface]:
    """Return five rows of books and binders, their backs almost in one plane."""
    wood = paint(rng)
    found = box(wall.at(0.0, 0.15, 1.0), (2 * half_m, 0.3, 2.0), wall.yaw_rad, [wood])
    for row in range(5):
        left = -half_m + 0.03
        while left < half_m - 0.1:
            thick, tall = rng.uniform(0.025, 0.08), rng.uniform(0.22, 0.34)
            spot = wall.at(left + thick / 2, 0.34 + rng.uniform(0.0, 0.02), 0.06 + 0.39 * row + tall / 2)
            found += box(spot, (thick, 0.12, tall), wall.yaw_rad, [spines[rng.integers(len(spines))]])
            left += thick + (rng.uniform(0.05, 0.25) if rng.uniform() < 0.06 else 0.003)
    return found


def _trim(rng: np.random.Generator, wall: _Wall, half_m: float, paints: list[Texture]) -> list[Surface]:
    """Return a skirting board, and what bare walls have near corners: sockets and switches."""
    plate, middle, skirting = (paints[i] for i in rng.permutation(len(paints))[:3])
    found = box(wall.at(0.0, 0.01, 0.04), (2 * half_m, 0.02, 0.08), wall.yaw_rad, [skirting])
    for side, heights in ((-1, (0.3, 1.1)), (1, (0.3, 1.1, 1.7))):
        for height in heights:
            place = side * (half_m - rng.uniform(0.3, 1.5))
            found += box(wall.at(place, 0.005, height), (0.16, 0.01, 0.08), wall.yaw_rad, [plate])
            for away in (-0.04, 0.04):
                found += box(wall.at(place + away, 0.01, height), (0.05, 0.01, 0.05), wall.yaw_rad, [middle])
    return found
