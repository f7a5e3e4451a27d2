"""Landmarks sorted by id, in chunks whose versions tell a viewer what to draw again."""

import numpy as np
from numpy.typing import NDArray

CHUNK_LANDMARKS = 1024


class LandmarkTable:
    """Landmarks by id. Updates are whole-array; nothing loops over points."""

    def __init__(self) -> None:
        self._ids = np.zeros(0, dtype=np.int64)
        self._xyz = np.zeros((0, 3), dtype=np.float32)
        self._rgb = np.zeros((0, 3), dtype=np.uint8)
        self._confidence = np.zeros(0, dtype=np.float32)
        self._alive = np.zeros(0, dtype=bool)
        self.chunk_versions: list[int] = []

    def __len__(self) -> int:
        return int(self._alive.sum())

    def update(
        self,
        ids: NDArray[np.int64],
        xyz: NDArray[np.float64],
        rgb: NDArray[np.uint8],
        confidence: NDArray[np.float32],
    ) -> None:
        """Add landmarks or replace those already known; of an id given twice the last one counts."""
        if len(ids) == 0:
            return
        ids, last = np.unique(ids[::-1], return_index=True)
        last = len(xyz) - 1 - last
        new = ids[~np.isin(ids, self._ids)]
        if len(new):
            self._insert(new)
        rows = np.searchsorted(self._ids, ids)
        self._xyz[rows] = np.asarray(xyz)[last]
        self._rgb[rows] = rgb[last]
        self._confidence[rows] = confidence[last]
        self._alive[rows] = True
        self._touch(rows)

    def _insert(self, new: NDArray[np.int64]) -> None:
        """Make room for ids that are not yet there; they usually go to the end."""
        places = np.searchsorted(self._ids, new)
        moved = np.arange(int(places.min()), len(self._ids))
        self._ids = np.insert(self._ids, places, new)
        self._xyz = np.insert(self._xyz, places, 0.0, axis=0)
        self._rgb = np.insert(self._rgb, places, 0, axis=0)
        self._confidence = np.insert(self._confidence, places, 0.0)
        self._alive = np.insert(self._alive, places, False)
        if len(moved):
            self._touch(np.arange(int(moved[0]), len(self._ids)))

    def remove(self, ids: NDArray[np.int64]) -> None:
        """Hide landmarks; unknown ids are ignored."""
        rows = np.flatnonzero(np.isin(self._ids, ids) & self._alive)
        self._alive[rows] = False
        self._touch(rows)
        if len(self._ids) > max(CHUNK_LANDMARKS, 2 * len(self)):
            self._close_gaps()

    def _close_gaps(self) -> None:
        """Forget rows of hidden landmarks: a long drive hides without end what a bounded map gives up."""
        self._touch(np.arange(len(self._ids)))
        alive = self._alive
        self._ids, self._confidence = self._ids[alive], self._confidence[alive]
        self._xyz, self._rgb = self._xyz[alive], self._rgb[alive]
        self._alive = alive[alive]

    def _touch(self, rows: NDArray[np.int64]) -> None:
        while len(self.chunk_versions) * CHUNK_LANDMARKS < len(self._ids):
            self.chunk_versions.append(0)
        for k in np.unique(rows // CHUNK_LANDMARKS).tolist():
            self.chunk_versions[k] += 1

    def chunk(self, idx: int) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]:
        """Return ``(xyz, rgb, confidence)`` of the living landmarks of one chunk."""
        rows = slice(idx * CHUNK_LANDMARKS, (idx + 1) * CHUNK_LANDMARKS)
        alive = self._alive[rows]
        return self._xyz[rows][alive], self._rgb[rows][alive], self._confidence[rows][alive]

    def median_distance(self, centre: NDArray[np.float64]) -> float:
        """Return the median distance of living landmarks from a point, 0 where there are none."""
        xyz = self._xyz[self._alive]
        return float(np.median(np.linalg.norm(xyz - centre, axis=1))) if len(xyz) else 0.0
