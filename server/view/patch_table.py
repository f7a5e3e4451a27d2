"""Dense points by keyframe, with versions that tell a viewer which points are new and which only moved."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.dense.cloud import DensePatch

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedPatch:
    """The dense points of one keyframe, and where they are.

    Attributes:
        frame_id: Of the keyframe.
        T_world_points: 4x4 similarity from the points' frame and unit to the world.
        points: The points, or None where a viewer has them and only their place is another.
    """

    frame_id: int
    T_world_points: Array
    points: DensePatch | None


class PatchTable:
    """Patches by the frame id of their keyframe; those without a pose yet wait for it."""

    def __init__(self) -> None:
        self._patches: dict[int, DensePatch] = {}
        self._T_world_points: dict[int, Array] = {}
        #: Of points and of place.
        self._versions: dict[int, tuple[int, int]] = {}

    def add(self, patch: DensePatch) -> None:
        """Add a patch, or replace the one of the same keyframe; ``place`` says where it is."""
        known = self._patches.get(patch.frame_id)
        self._patches[patch.frame_id] = patch
        points, place = self._versions.get(patch.frame_id, (0, 0))
        if known is None or known.xyz is not patch.xyz:
            points += 1
        self._versions[patch.frame_id] = (points, place)

    def place(self, T_world_kf: Mapping[int, Array], frame_ids: Iterable[int]) -> None:
        """Put the patches of some keyframes where those are now.

        Args:
            T_world_kf: Pose of each keyframe, 4x4.
            frame_ids: Which to look at.
        """
        for frame_id in frame_ids:
            patch, T = self._patches.get(frame_id), T_world_kf.get(frame_id)
            if patch is None or T is None:
                continue
            T_world_points = T.copy()
            T_world_points[:3, :3] *= patch.scale
            known = self._T_world_points.get(frame_id)
            if known is None or not np.array_equal(known, T_world_points):
                self._T_world_points[frame_id] = T_world_points
                points, place = self._versions[frame_id]
                self._versions[frame_id] = (points, place + 1)

    def changes_since(self, seen: dict[int, tuple[int, int]]) -> list[PlacedPatch]:
        """Return what a viewer has not seen, and note in ``seen`` that it has now."""
        changes = []
        for frame_id, T_world_points in self._T_world_points.items():
            version, before = self._versions[frame_id], seen.get(frame_id, (0, 0))
            if version != before:
                points = self._patches[frame_id] if version[0] != before[0] else None
                changes.append(PlacedPatch(frame_id, T_world_points, points))
                seen[frame_id] = version
        return changes
