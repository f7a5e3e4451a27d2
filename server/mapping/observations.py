"""What keyframes, or frames that wait for a map, saw of some tracks."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.track_ids import rows_among

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


class View(Protocol):
    """A keyframe, or a frame that waits for a map, with the tracks it saw, one a row."""

    @property
    def ids(self) -> Ids:
        """``(M,)`` tracks, each once."""

    @property
    def xy(self) -> Array:
        """``(M, 2)`` pixels where."""

    @property
    def confidence(self) -> Array:
        """``(M,)`` in [0, 1]."""

    @property
    def edge(self) -> Array:
        """``(M, 2)``, see ``geometry.edges``."""


class Observations(NamedTuple):
    """Observations of tracks in views, one a row.

    Attributes:
        view: ``(M,)`` which view.
        point: ``(M,)`` row of the track among those asked for.
        xy: ``(M, 2)`` pixels.
        confidence: ``(M,)`` in [0, 1].
        edge: ``(M, 2)`` see ``edges``.
    """

    view: NDArray[np.intp]
    point: NDArray[np.intp]
    xy: Array
    confidence: Array
    edge: Array

    def of_rows(self, kept: NDArray[np.bool_], point: NDArray[np.intp]) -> "Observations":
        """Return the observations in the mask ``kept (M,)``, with new track rows ``point``."""
        return Observations(self.view[kept], point, self.xy[kept], self.confidence[kept], self.edge[kept])


def gather_observations(views: Sequence[View], ids: Ids) -> Observations:
    """Find every observation of some tracks in some views.

    Args:
        views: One at least; each sees a track once.
        ids: ``(P,)`` tracks, ascending.

    Returns:
        View ``(M,)``, row into ``ids (M,)``, pixel ``(M, 2)``, confidence ``(M,)`` and edge ``(M, 2)`` of
        each, view by view.
    """
    view, point, xy, confidence, edge = [], [], [], [], []
    for k, seen in enumerate(views):
        row = rows_among(seen.ids, ids)
        hit = row >= 0
        view.append(np.full(int(hit.sum()), k, np.intp))
        point.append(row[hit])
        xy.append(seen.xy[hit])
        confidence.append(seen.confidence[hit])
        edge.append(seen.edge[hit])
    places = (np.concatenate(column) for column in (xy, confidence, edge))
    return Observations(np.concatenate(view), np.concatenate(point), *places)
