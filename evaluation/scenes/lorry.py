"""A drive behind a lorry: much of what the camera sees goes where the camera goes."""

import numpy as np

from semcast.evaluation.scenes.motion import Pace, Wobble
from semcast.evaluation.scenes.street import Street
from semcast.evaluation.scenes.surfaces import Surface, box
from semcast.evaluation.scenes.textures import dead_leaves

#: Length, width and height of the lorry, its clearance, and about how far ahead its rear is.
_SIZE_M, _CLEARANCE_M, _GAP_M = (8.0, 2.5, 3.2), 0.3, 8.0
#: How much farther the car ahead is than on a street without a lorry.
_BEFORE_M = 20.0


class Lorry(Street):
    """A street whose far end a lorry hides, and in bends half of what is beside it."""

    _ahead_of_camera_m = _GAP_M + _SIZE_M[0]

    def __init__(self, seed: int, pace: Pace) -> None:
        """Build the streets and paint the lorry."""
        super().__init__(seed, pace)
        self._ahead_m += _BEFORE_M
        rng = np.random.default_rng([seed, 6])
        self._painted = [dead_leaves(rng, 0.6)]
        self._gap = Wobble.drawn(rng, 0.8, 0.03, 0.15)

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return the street and the lorry."""
        length, _, height = _SIZE_M
        x, y, yaw = self.in_lane(self.camera_way_m(t_s) + _GAP_M + self._gap.at(t_s) + length / 2)
        lorry = box((x, y, _CLEARANCE_M + height / 2), _SIZE_M, yaw, self._painted)
        return [*super().surfaces(t_s), *lorry]
