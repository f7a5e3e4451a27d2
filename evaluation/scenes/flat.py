"""A living room with bare walls through a handheld camera: a few things, and little else to hold on to."""

import numpy as np
from numpy.typing import NDArray

from semcast.evaluation.scenes.room import Room, walls_of
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import dead_leaves, paint

Array = NDArray[np.float64]

_LENGTH_M, _WIDTH_M = Room.size_m[:2]
#: Fine grain of plain paint, below the noise of the camera.
_GRAIN = 0.5


class Flat(Room):
    """Bare walls with few pictures, a carpet, a sofa, a table with things on it, books and a door.

    The camera is that of ``Room`` and moved like that, at half the frames a second.
    """

    rate_hz = 15.0
    stream = 8

    @staticmethod
    def furnished(rng: np.random.Generator) -> list[Surface]:
        """Return walls and furniture."""
        plain = paint(rng, _GRAIN)
        carpet = dead_leaves(rng, 0.12, max_radius_share=0.02)
        walls = walls_of([plain, plain, plain, plain, carpet, paint(rng, _GRAIN)], (3.0, 3.0))
        found = [*walls, *_pictures(rng, walls[:4])]
        found += _sofa(rng) + _table(rng) + _books(rng)
        door = (0.03, 1.2, 1.0), (0.06, 0.9, 2.0)
        return [*found, *box(*door, 0.0, [paint(rng, _GRAIN)])]


def _pictures(rng: np.random.Generator, walls: list[Surface]) -> list[Surface]:
    """Return one picture or two on each of two walls."""
    found = []
    for index in rng.permutation(len(walls))[:2]:
        wall = walls[index]
        along = wall.edge_u_m / np.linalg.norm(wall.edge_u_m)
        inward = np.array([_LENGTH_M / 2, _WIDTH_M / 2, 0.0]) - wall.corner_m * (1, 1, 0)
        inward -= along * (inward @ along)
        for place in rng.permutation([1.2, 3.2])[: rng.integers(1, 3)]:
            wide, tall = rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6)
            top = wall.corner_m + along * place + 0.02 * inward / np.linalg.norm(inward) - (0, 0, 0.8)
            found.append(Surface(top, along * wide, np.array([0, 0, -tall]), dead_leaves(rng)))
    return found


def _sofa(rng: np.random.Generator) -> list[Surface]:
    x, cloth = rng.uniform(1.6, 4.4), paint(rng)
    found = box((x, 0.5, 0.22), (2.0, 0.85, 0.44), 0.0, [cloth])
    found += box((x, 0.15, 0.6), (2.0, 0.2, 0.5), 0.0, [cloth])
    for away in (-0.6, 0.0, 0.6):
        cushion = (x + away, 0.33, 0.6), (0.4, 0.12, 0.3)
        found += box(*cushion, rng.normal(0, 0.2), [dead_leaves(rng, 0.6)])
    return found


def _table(rng: np.random.Generator) -> list[Surface]:
    x, y, wood = rng.uniform(2.2, 3.8), rng.uniform(2.0, 3.0), paint(rng)
    found = box((x, y, 0.38), (1.1, 0.6, 0.05), 0.0, [wood])
    for dx in (-0.5, 0.5):
        for dy in (-0.25, 0.25):
            found += box((x + dx, y + dy, 0.18), (0.05, 0.05, 0.36), 0.0, [wood])
    for _ in range(5):
        size = rng.uniform(0.08, 0.25), rng.uniform(0.06, 0.2), rng.uniform(0.03, 0.15)
        place = x + rng.uniform(-0.4, 0.4), y + rng.uniform(-0.2, 0.2), 0.405 + size[2] / 2
        found += box(place, size, rng.uniform(0, np.pi), [dead_leaves(rng)])
    return found


def _books(rng: np.random.Generator) -> list[Surface]:
    """Return a case with four rows of books against the far wall."""
    y, wood = rng.uniform(1.2, _WIDTH_M - 1.2), paint(rng)
    found = box((_LENGTH_M - 0.15, y, 0.95), (0.3, 1.3, 1.9), 0.0, [wood])
    spines = [paint(rng) for _ in range(8)]
    for row in range(4):
        left = -0.6
        while left < 0.55:
            thick, tall = rng.uniform(0.02, 0.05), rng.uniform(0.22, 0.36)
            place = _LENGTH_M - 0.37, y + left + thick / 2, 0.1 + 0.45 * row + tall / 2
            found += box(place, (0.14, thick, tall), 0.0, [spines[rng.integers(len(spines))]])
            left += thick + (0.1 if rng.uniform() < 0.15 else 0.003)
    return found
