"""A drive once round a block of houses, and on along the street it began in."""

import numpy as np
from numpy.typing import NDArray

from semcast.evaluation.scenes.street import STEP_M, Street, smoothed

Array = NDArray[np.float64]

#: Laps the road has, as many as the longest recording gets round.
_NUM_LAPS = 8


class Block(Street):
    """A street that ends where it began: what has drifted until then can be seen there."""

    def _course(self, rng: np.random.Generator) -> tuple[Array, int]:
        """Return the road's curvature every ``STEP_M``, smoothed, and how many of these steps are one lap."""
        long, short = (rng.uniform(*limits) / STEP_M for limits in ((38, 50), (28, 38)))
        turn = rng.choice([-1.0, 1.0])
        steps = int(rng.uniform(9, 12) * np.pi / 2 / STEP_M)
        # Exactly a right angle: four of them close the line.
        corner = np.full(steps, turn * np.pi / 2 / (steps * STEP_M))
        half, across = np.zeros(int(long / 2)), np.zeros(int(short))
        lap = np.concatenate([half, corner, across, corner, half, half, corner, across, corner, half])
        return np.tile(smoothed(lap), _NUM_LAPS), len(lap)
