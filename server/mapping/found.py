"""Where tracks were found in an image, filled in step by step as one way of looking follows another."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.features import TrackedPoints

Array = NDArray[np.float64]


@dataclass
class Found:
    """Where tracks were found, row by row.

    Attributes:
        ok: ``(N,)`` bool.
        xy: ``(N, 2)``; of those that were not found, where they were last.
        forward_backward: ``(N,)`` pixels, see ``TrackedPoints``; so are the others.
        photometric: ``(N,)``.
        gradient: ``(N,)``.
    """

    ok: NDArray[np.bool_]
    xy: Array
    forward_backward: Array
    photometric: Array
    gradient: Array

    @staticmethod
    def nothing(xy: Array) -> "Found":
        """Return that of tracks at ``xy (N, 2)`` none was found."""
        count = len(xy)
        return Found(np.zeros(count, bool), xy.copy(), np.full(count, 9.0), np.zeros(count), np.zeros(count))

    def take(self, rows: NDArray[np.intp], points: TrackedPoints) -> None:
        """Replace some rows."""
        self.ok[rows] = points.ok
        self.xy[rows] = points.xy
        self.forward_backward[rows] = points.forward_backward_px
        self.photometric[rows] = points.photometric_grey
        self.gradient[rows] = points.gradient_grey2
