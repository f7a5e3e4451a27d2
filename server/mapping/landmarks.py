"""Landmarks of a map as columns, sorted by id."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.track_ids import rows_among

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


class Landmarks:
    """Landmarks by id, ids ascending; an id is that of the track the landmark was made from.

    Attributes:
        ids: ``(N,)`` int64, ascending.
        xyz: ``(N, 3)`` world frame.
        rgb: ``(N, 3)`` uint8.
        confidence: ``(N,)`` float32 in [0, 1], mean over the observations it was made from.
        submap: ``(N,)`` int64.
        born: ``(N,)`` int64, frame id of the keyframe that made it.
        last_seen: ``(N,)`` int64, frame id of the last frame it was seen in.
        num_missed: ``(N,)`` int64, observations in a row that did not agree with it.
    """

    _COLUMNS = ("ids", "xyz", "rgb", "confidence", "submap", "born", "last_seen", "num_missed")

    def __init__(self) -> None:
        self.ids: Ids = np.zeros(0, np.int64)
        self.xyz: Array = np.zeros((0, 3))
        self.rgb: NDArray[np.uint8] = np.zeros((0, 3), np.uint8)
        self.confidence: NDArray[np.float32] = np.zeros(0, np.float32)
        self.submap: Ids = np.zeros(0, np.int64)
        self.born: Ids = np.zeros(0, np.int64)
        self.last_seen: Ids = np.zeros(0, np.int64)
        self.num_missed: Ids = np.zeros(0, np.int64)

    def __len__(self) -> int:
        return len(self.ids)

    def points(self) -> tuple[Ids, Array, NDArray[np.uint8], NDArray[np.float32]]:
        """Return copies of ids, positions, colours and confidence."""
        return self.ids.copy(), self.xyz.copy(), self.rgb.copy(), self.confidence.copy()

    def rows(self, ids: Ids) -> NDArray[np.intp]:
        """Row of each id, -1 for one that is not there."""
        return rows_among(ids, self.ids)

    def xyz_of(self, ids: Ids) -> Array:
        """Positions ``(M, 3)`` of those of the ids that are there."""
        row = self.rows(ids)
        return self.xyz[row[row >= 0]]

    def add(
        self,
        ids: Ids,
        xyz: Array,
        rgb: NDArray[np.uint8],
        confidence: NDArray,
        submap: int,
        frame_id: int | Ids,
    ) -> None:
        """Add landmarks whose ids are new, made by one keyframe or each by its own."""
        if len(ids) == 0:
            return
        columns = {
            "ids": ids,
            "xyz": xyz,
            "rgb": rgb,
            "confidence": confidence.astype(np.float32),
            "submap": np.full(len(ids), submap, np.int64),
            "born": np.full(len(ids), frame_id, np.int64),
            "last_seen": np.full(len(ids), frame_id, np.int64),
            "num_missed": np.zeros(len(ids), np.int64),
        }
        order = np.argsort(np.concatenate([self.ids, ids]), kind="stable")
        for name, values in columns.items():
            setattr(self, name, np.concatenate([getattr(self, name), values])[order])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Forget all landmarks outside the mask."""
        for name in self._COLUMNS:
            setattr(self, name, getattr(self, name)[mask])

    def arrays(self) -> dict[str, NDArray]:
        """Columns for a checkpoint."""
        return {f"landmarks.{name}": getattr(self, name).copy() for name in self._COLUMNS}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take the columns of a checkpoint."""
        for name in self._COLUMNS:
            setattr(self, name, np.array(arrays[f"landmarks.{name}"]))
