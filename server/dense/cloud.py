"""The points of all keyframes' depth: each hangs on its keyframe and goes with it when the map moves."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.geometry.projection import depths_in
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Points at most; beyond it the older half of the patches keeps every second of its points.
MAX_POINTS = 1_000_000
#: A patch is handed out again where its scale has changed by more than this share.
_SCALE_CHANGE = 1e-3
#: Landmarks of a keyframe that must be left to tell its scale.
_MIN_LANDMARKS = 5


@dataclass(frozen=True)
class DensePatch:
    """What one keyframe adds to the cloud.

    A point is at ``T_world_cam @ (scale * xyz)`` with the keyframe's present pose.

    Attributes:
        frame_id: Of the keyframe.
        xyz: ``(N, 3)`` float32 in its camera frame, in map units of when they were made.
        rgb: ``(N, 3)`` uint8.
        confidence: ``(N,)`` float32 in [0, 1], of the pixels they are from.
        scale: Present map units in one of then.
    """

    frame_id: int
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    scale: float = 1.0

    def thinned(self) -> "DensePatch":
        """Return it with every second point, rather one less than one more."""
        return self._only(slice(1, None, 2))

    def emptied(self) -> "DensePatch":
        """Return it without points, for who has to take away what it had."""
        return self._only(slice(0))

    def _only(self, rows: slice) -> "DensePatch":
        xyz, rgb, confidence = self.xyz[rows], self.rgb[rows], self.confidence[rows]
        # As views they would keep all points in memory.
        return replace(self, xyz=xyz.copy(), rgb=rgb.copy(), confidence=confidence.copy())


@dataclass(frozen=True)
class CloudPoints:
    """Points in the world frame.

    Attributes:
        xyz: ``(N, 3)`` float64, map units.
        rgb: ``(N, 3)`` uint8.
        confidence: ``(N,)`` float32 in [0, 1].
    """

    xyz: Array
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]


def landmark_depths(world: WorldMap, keyframe: Keyframe) -> tuple[Ids, Array]:
    """Return the landmarks ``(N,)`` in front of a keyframe that sees them, and their depths ``(N,)``."""
    row = world.landmarks.rows(keyframe.ids)
    ids, xyz = keyframe.ids[row >= 0], world.landmarks.xyz[row[row >= 0]]
    depth = depths_in(invert_transform(keyframe.T_world_cam), xyz)
    return ids[depth > 0.0], depth[depth > 0.0]


def scale_since(world: WorldMap, frame_id: int, ids: Ids, before: Array) -> float | None:
    """Tell how many present map units one of earlier is, around a frame; None with too few landmarks.

    Args:
        world: The map as it is.
        frame_id: Of the frame.
        ids: ``(L,)`` landmarks it saw.
        before: ``(L,)`` how far they were from it.
    """
    T_world_cam = world.pose_of_frame(frame_id)
    if T_world_cam is None:
        return None
    row = world.landmarks.rows(ids)
    there = row >= 0
    depth = depths_in(invert_transform(T_world_cam), world.landmarks.xyz[row[there]])
    sound = depth > 0.0
    if sound.sum() < _MIN_LANDMARKS:
        return None
    return float(np.median(depth[sound] / before[there][sound]))


class DenseCloud:
    """Collects patches, keeps their scale that of the map, and bounds their number.

    Args:
        max_points: Points at most.
    """

    def __init__(self, max_points: int = MAX_POINTS) -> None:
        self._max_points = max_points
        self._patches: dict[int, DensePatch] = {}
        self._landmarks: dict[int, tuple[Ids, Array]] = {}
        self._changed: set[int] = set()

    def __len__(self) -> int:
        return sum(len(patch.xyz) for patch in self._patches.values())

    def add(self, patch: DensePatch, ids: Ids, depth: Array) -> None:
        """Add a keyframe's points.

        Args:
            patch: The points.
            ids: ``(L,)`` landmarks that the keyframe sees.
            depth: ``(L,)`` how far they are from it, in the units of the points.
        """
        self._landmarks[patch.frame_id] = (ids, depth)
        self._put(patch)
        while len(self) > self._max_points:
            holding = [k for k in sorted(self._patches) if len(self._patches[k].xyz)]
            for frame_id in holding[: (len(holding) + 1) // 2]:
                self._put(self._patches[frame_id].thinned())

    def _put(self, patch: DensePatch) -> None:
        """Let a patch take the place of the one before it; of an empty one the scale is of no interest."""
        self._patches[patch.frame_id] = patch
        self._changed.add(patch.frame_id)
        if not len(patch.xyz):
            self._landmarks.pop(patch.frame_id, None)

    def follow(self, world: WorldMap, frame_ids: Collection[int]) -> None:
        """Take the scale of keyframes that moved from their landmarks: joined parts and loops change it."""
        for frame_id in frame_ids:
            if frame_id not in self._landmarks:
                continue
            patch, scale = self._patches[frame_id], scale_since(world, frame_id, *self._landmarks[frame_id])
            if scale is not None and abs(scale / patch.scale - 1.0) > _SCALE_CHANGE:
                self._put(replace(patch, scale=scale))

    def withdraw(self, frame_ids: Collection[int]) -> None:
        """Empty the patches of keyframes whose pose was taken back."""
        for frame_id in frame_ids:
            if (patch := self._patches.get(frame_id)) is not None and len(patch.xyz):
                self._put(patch.emptied())

    def take_changes(self) -> tuple[DensePatch, ...]:
        """Return patches that were added or changed since this was last called, by frame id.

        Those that were emptied are forgotten then: a camera that runs for days has keyframes without end.
        """
        changed, self._changed = sorted(self._changed), set()
        patches = tuple(self._patches[frame_id] for frame_id in changed)
        for patch in patches:
            if not len(patch.xyz):
                del self._patches[patch.frame_id]
        return patches

    def points(self, world: WorldMap) -> CloudPoints:
        """Return all points with the present poses; those of keyframes without a pose are left out."""
        return _placed(self._patches.values(), world)


def _placed(patches: Iterable[DensePatch], world: WorldMap) -> CloudPoints:
    """Return the points of patches in the world frame."""
    xyz, rgb, confidence = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0, np.float32)]
    for patch in patches:
        T_world_cam = world.pose_of_frame(patch.frame_id)
        if T_world_cam is not None:
            xyz.append(patch.scale * patch.xyz @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])
            rgb.append(patch.rgb)
            confidence.append(patch.confidence)
    return CloudPoints(np.concatenate(xyz), np.concatenate(rgb), np.concatenate(confidence))
