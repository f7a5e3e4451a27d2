"""What one image shows: the image itself with the rows that arrived, and tracks in it."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.slots import BLOCK_PX
from semcast.server.geometry.edges import alike, each_of
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.sampling import nearest_pixels
from semcast.server.geometry.streaks import band_power
from semcast.server.geometry.wide_search import WideFeatures
from semcast.server.mapping.state import DecodedFrame

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Slots at or below this SNR hold nothing of the image (a lost slot is at -20 dB).
LOST_SLOT_DB = -15.0


def usable_rows(frame: DecodedFrame, height: int) -> NDArray[np.bool_]:
    """Which rows of the image arrived, ``(H,)``; all where nothing is known about slots."""
    usable = np.ones(height, bool)
    if frame.slot_snr_db is not None:
        snr = np.nan_to_num(np.asarray(frame.slot_snr_db, dtype=np.float64), nan=-99.0)
        lost = np.repeat(snr <= LOST_SLOT_DB, BLOCK_PX)[:height]
        usable[: len(lost)] = ~lost
    return usable


@dataclass(frozen=True)
class Sight:
    """An image as the tracks see it.

    Attributes:
        frame: As received.
        grey: ``(H, W)``.
        usable: ``(H,)`` bool, rows that arrived.
    """

    frame: DecodedFrame
    grey: Grey
    usable: NDArray[np.bool_]

    @cached_property
    def usable_pixels(self) -> NDArray[np.bool_]:
        """Pixels that arrived, ``(H, W)``."""
        return np.repeat(self.usable[:, None], self.grey.shape[1], axis=1)

    @cached_property
    def wide_features(self) -> WideFeatures:
        """Features of what arrived: found once, when first asked for."""
        return WideFeatures.of(self.grey, self.usable_pixels)

    @cached_property
    def band_power(self) -> Array:
        """Of the image, see ``streaks``: by that streaks of motion blur are told."""
        return band_power(self.grey)

    def shows(self, xy: Array, margin_px: int) -> NDArray[np.bool_]:
        """Which points are in the image, no nearer to its border and to lost rows than a margin, ``(N,)``.

        Args:
            xy: ``(N, 2)`` pixels; NaN is nowhere.
            margin_px: Pixels.
        """
        height, width = self.grey.shape
        inside = (xy >= margin_px) & (xy < np.array([width, height]) - margin_px)
        return np.asarray(inside.all(axis=1)) & ~self.near_lost(xy, margin_px)

    def rows_near_lost(self, margin_px: int) -> NDArray[np.bool_]:
        """Which rows have a lost one within the margin, ``(H,)``."""
        around = np.convolve(~self.usable, np.ones(2 * margin_px + 1, int))
        return np.asarray(around[margin_px : margin_px + len(self.usable)] > 0)

    def near_lost(self, xy: Array, margin_px: int) -> NDArray[np.bool_]:
        """Which points have a lost row within the margin, ``(N,)``."""
        if self.usable.all():
            return np.zeros(len(xy), bool)
        reach = self.rows_near_lost(margin_px)
        return np.asarray(reach[nearest_pixels(xy, self.grey.shape)[:, 1]])


@dataclass(frozen=True)
class Seen:
    """Tracks as one image shows them.

    Attributes:
        ids: ``(N,)`` int64.
        xy: ``(N, 2)`` pixels.
        confidence: ``(N,)`` of the positions.
        edge: ``(N, 2)`` along which they are known less, see ``edges``; by default they have none.
    """

    ids: Ids
    xy: Array
    confidence: Array
    edge: Array = field(default_factory=alike)

    def __post_init__(self) -> None:
        """Have an edge for each observation."""
        object.__setattr__(self, "edge", each_of(self.edge, len(self.ids)))

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> "Seen":
        return Seen(self.ids[rows], self.xy[rows], self.confidence[rows], self.edge[rows])
