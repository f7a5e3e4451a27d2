"""Where tracks were found in an image, filled in step by step as one way of looking follows another."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.grey import Grey
from semcast.server.geometry.klt import TrackedPoints, track_alike
from semcast.server.geometry.square_distance import square_distances

Array = NDArray[np.float64]

#: Found tracks next to one that was missed, by whose error of the guess it is looked for again.
_NEIGHBOURS = 5
#: Tracks that must be found for that.
_MIN_NEIGHBOURS = 8


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

    def look_again(
        self, grey0: Grey, grey1: Grey, xy0: Array, guess1_xy: Array, rows: NDArray[np.intp]
    ) -> None:
        """Look for the missed ones of some tracks where those found next to them say they should be.

        Rows that did not arrive spoil the coarse levels of a pyramid, which make up for a poor guess.

        Args:
            grey0: Image in which these tracks were seen last, as bright as the new one.
            grey1: The new one.
            xy0: ``(N, 2)`` where all tracks were.
            guess1_xy: ``(N, 2)`` where they were expected.
            rows: ``(M,)`` the tracks.
        """
        missed, seen = rows[~self.ok[rows]], rows[self.ok[rows]]
        if len(missed) == 0 or len(seen) < _MIN_NEIGHBOURS:
            return
        square = square_distances(xy0[missed], xy0[seen])
        near = seen[np.argsort(square, axis=1, kind="stable")[:, :_NEIGHBOURS]]
        better = guess1_xy[missed] + np.median(self.xy[near] - guess1_xy[near], axis=1)
        self.take(missed, track_alike(grey0, grey1, xy0[missed], better, max_level=2))
