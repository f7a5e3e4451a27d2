"""What the viewer shows, kept as plain arrays: path, landmarks, truth, plots and the newest image.

The tracker moves old poses and landmarks whenever bundle adjustment ends. A scene remembers what each viewer
has already seen and hands out only what changed: the path in segments, the landmarks in chunks.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import project_to_so3
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import match_times
from semcast.server.dense.cloud import DensePatch
from semcast.server.mapping.state import MapUpdate, Marker
from semcast.server.view.frame_view import MISSING, FrameView
from semcast.server.view.landmark_table import LandmarkTable
from semcast.server.view.patch_table import PatchTable, PlacedPatch
from semcast.server.view.path_table import PathTable
from semcast.server.view.picture import Picture
from semcast.server.view.spectator import Spectator

Array = NDArray[np.float64]

#: Rows kept; of plot values a viewer that comes late, or stands still for so long, lacks those before.
MAX_ROWS = 20_000
#: Depth of the drawn frustum as share of the median landmark distance.
FRUSTUM_SHARE = 0.15
_NO_MARKER = Marker(np.zeros((0, 3)), "")


@dataclass(frozen=True)
class Row:
    """One frame's place on the time axis, its pose, state and plot values.

    Attributes:
        frame_id: Index of the frame in its source.
        t_source_ns: Recorded time of the frame.
        T_world_cam: 4x4, or None where the frame has no pose.
        T_world_eye: 4x4 of the spectator who follows the camera, None as ``T_world_cam``.
        state: Tracking state in words, or ``MISSING``.
        scalars: Plot path to value.
    """

    frame_id: int
    t_source_ns: int
    T_world_cam: Array | None
    T_world_eye: Array | None
    state: str
    scalars: dict[str, float]


@dataclass(frozen=True)
class PointChunk:
    """Landmarks that are logged together; ``xyz`` is empty when all of them were removed."""

    idx: int
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]


@dataclass(frozen=True)
class Changes:
    """What a viewer has not seen yet.

    Attributes:
        cleared: The map was started anew: forget path and landmarks first.
        rows: Frames since the last call, in order.
        segments: Index to line strips, each ``(n, 3)``.
        chunks: Landmarks that were added, moved or removed.
        patches: Dense points that were added or moved.
        truth: ``(N, 3)`` aligned true path, or None when unchanged.
        marker: None when unchanged.
        picture: The newest image, or None when unchanged.
        frustum_size: Distance of the drawn image plane in map units, or None when unchanged.
    """

    cleared: bool
    rows: list[Row]
    segments: dict[int, list[NDArray[np.float32]]]
    chunks: list[PointChunk]
    patches: list[PlacedPatch]
    truth: NDArray[np.float32] | None
    marker: Marker | None
    picture: Picture | None
    frustum_size: float | None

    @property
    def empty(self) -> bool:
        """True when there is nothing to log."""
        return not (
            self.cleared
            or self.rows
            or self.segments
            or self.chunks
            or self.patches
            or self.truth is not None
            or self.marker is not None
            or self.picture is not None
            or self.frustum_size is not None
        )


@dataclass
class Cursor:
    """What one viewer has seen. A fresh cursor has seen nothing."""

    generation: int = 0
    num_rows: int = 0
    segments: dict[int, int] = field(default_factory=dict)
    chunks: dict[int, int] = field(default_factory=dict)
    patches: dict[int, tuple[int, int]] = field(default_factory=dict)
    truth_version: int = 0
    marker_version: int = 0
    picture_id: int = -1
    frustum_size: float = 0.0


class Scene:
    """Collects frames and map updates; ``changes_since`` says what a viewer lacks. Not thread-safe.

    Args:
        truth: True path, or None.
        truth_times_ns: ``(N,)`` times by frame id on the clock of ``truth``; None where that is the stream's.
    """

    def __init__(
        self, truth: Trajectory | None = None, truth_times_ns: NDArray[np.int64] | None = None
    ) -> None:
        self._truth = truth
        self._truth_times_ns = truth_times_ns
        self._generation = 0
        self._rows: deque[Row] = deque(maxlen=MAX_ROWS)
        self._num_rows = 0
        self._picture: Picture | None = None
        self._clear_map()

    def _clear_map(self) -> None:
        self._path = PathTable()
        self._lost_since_pose = False
        self._table = LandmarkTable()
        self._patches = PatchTable()
        self._truth_version = 0
        self._aligned: NDArray[np.float32] | None = None
        self._marker = _NO_MARKER
        self._marker_version = 0
        self._frustum_size = 0.0
        self._size = 0.0
        self._spectator = Spectator()

    def start_new_map(self) -> None:
        """Forget path and landmarks; plots go on."""
        self._generation += 1
        self._clear_map()

    def add_frame(self, view: FrameView) -> None:
        """Take one frame's pose and plot values; its picture comes by ``set_picture``."""
        T_world_eye = (
            None if view.T_world_cam is None else self._spectator.follow(view.T_world_cam, self._size)
        )
        self._rows.append(
            Row(view.frame_id, view.t_source_ns, view.T_world_cam, T_world_eye, view.state, view.scalars)
        )
        self._num_rows += 1
        for frame_id, t_source_ns, T_world_cam in view.backfilled:
            if frame_id in view.after_gaps:
                self.interrupt_path()
            self._insert_pose(frame_id, t_source_ns, T_world_cam)
        if view.T_world_cam is None:
            if view.state != MISSING:
                self.interrupt_path()
            return
        self._insert_pose(view.frame_id, view.t_source_ns, view.T_world_cam)
        self._lost_since_pose = False

    def interrupt_path(self) -> None:
        """Begin a new line with the next pose: nothing tells how the camera came there."""
        self._lost_since_pose = len(self._path) > 0

    def _insert_pose(self, frame_id: int, t_source_ns: int, T_world_cam: Array) -> None:
        T = np.asarray(T_world_cam, dtype=np.float64)
        # Of frames that are posed together only the first one comes after the gap.
        is_after_gap = self._lost_since_pose and frame_id > self._path.newest_id
        self._path.insert(frame_id, t_source_ns, T, is_after_gap=is_after_gap)
        self._lost_since_pose &= not is_after_gap

    def update(self, update: MapUpdate) -> None:
        """Take what changed in the map."""
        self.set_keyframes(update.keyframe_ids, update.keyframe_poses)
        self.move_frames(update.frame_ids, update.frame_poses)
        self.withdraw_frames(update.withdrawn)
        self.set_marker(update.marker)
        self.add_landmarks(update.ids, update.xyz, update.rgb, update.confidence, update.removed)

    def move_frames(self, ids: NDArray[np.int64], T_world_cam: Array) -> None:
        """Set the poses ``(F, 4, 4)`` of frames that did not just move with a keyframe."""
        self._path.move(dict(zip(ids.tolist(), T_world_cam, strict=True)))

    def withdraw_frames(self, ids: NDArray[np.int64]) -> None:
        """Take frames out of the path whose pose was taken back; unknown ones are no error."""
        self._path.withdraw(ids.tolist())

    def add_landmarks(
        self,
        ids: NDArray[np.int64],
        xyz: Array,
        rgb: NDArray[np.uint8],
        confidence: NDArray[np.float32],
        removed: NDArray[np.int64],
    ) -> None:
        """Add or move ``(N,)`` landmarks by id and take away the removed ones."""
        self._table.update(ids, xyz, rgb, confidence)
        self._table.remove(removed)
        self._measure()

    def set_keyframes(self, ids: NDArray[np.int64], T_world_kf: Array) -> None:
        """Set ``(K,)`` keyframe poses ``(K, 4, 4)``; frames that hang on a moved one move with it."""
        poses = np.asarray(T_world_kf, dtype=np.float64)
        self._path.set_keyframes(dict(zip(ids.tolist(), poses, strict=True)))
        self._patches.place(self._path.keyframes, ids.tolist())

    def set_patches(self, patches: Sequence[DensePatch]) -> None:
        """Add or replace the dense points of keyframes."""
        for patch in patches:
            self._patches.add(patch)
        self._patches.place(self._path.keyframes, [patch.frame_id for patch in patches])

    def set_picture(self, picture: Picture) -> None:
        """Replace the newest image."""
        self._picture = picture

    def set_marker(self, marker: Marker | None) -> None:
        """Set where the marker is that tells the metre, None while none does."""
        marker = _NO_MARKER if marker is None else marker
        if marker is not self._marker:
            self._marker = marker
            self._marker_version += 1

    def poses(self) -> Array:
        """Return ``T_world_cam`` ``(N, 4, 4)`` of posed frames, after all corrections."""
        return self._path.poses()

    def align_truth(self) -> None:
        """Fit the truth to the path anew; a no-op while the path is too short to fit."""
        if self._truth is None or len(self._path) < 3:
            return
        times_ns = self._path.times_ns
        if self._truth_times_ns is not None:
            # Frames of a later pass have no time there.
            frame_ids = self._path.frame_ids
            times_ns = self._truth_times_ns[frame_ids[frame_ids < len(self._truth_times_ns)]]
        place, truth_idx = match_times(ns_to_seconds(times_ns), self._truth.t_s)
        fit = align_poses(self._truth.T_world_cam[truth_idx], self.poses()[place])
        if fit is None:
            return
        scale, R, t = fit
        self._aligned = (scale * self._truth.positions @ R.T + t).astype(np.float32)
        self._truth_version += 1

    def _measure(self) -> None:
        """Take the scene's size from the landmarks around the camera; a frustum follows it in steps."""
        centre = self._path.newest_centre
        if centre is None:
            return
        self._size = self._table.median_distance(centre) or self._size
        wanted = FRUSTUM_SHARE * self._size
        if wanted > 0 and not 0.75 * wanted < self._frustum_size < 1.33 * wanted:
            self._frustum_size = wanted

    def changes_since(self, cursor: Cursor) -> Changes:
        """Return what the cursor has not seen and move it on."""
        cleared = cursor.generation != self._generation
        if cleared:
            cursor.segments.clear()
            cursor.chunks.clear()
            cursor.patches.clear()
            cursor.truth_version = 0
            cursor.marker_version = 0
            cursor.frustum_size = 0.0
            cursor.generation = self._generation
        missing = min(self._num_rows - cursor.num_rows, len(self._rows))
        rows = [self._rows[k] for k in range(len(self._rows) - missing, len(self._rows))]
        cursor.num_rows = self._num_rows
        segments = {}
        for k, version in enumerate(self._path.segment_versions):
            if cursor.segments.get(k) != version:
                cursor.segments[k] = version
                segments[k] = self._path.strips(k)
        chunks = []
        for k, version in enumerate(self._table.chunk_versions):
            if cursor.chunks.get(k) != version:
                cursor.chunks[k] = version
                chunks.append(PointChunk(k, *self._table.chunk(k)))
        patches = self._patches.changes_since(cursor.patches)
        truth = self._aligned if cursor.truth_version != self._truth_version else None
        cursor.truth_version = self._truth_version
        marker = self._marker if cursor.marker_version != self._marker_version else None
        cursor.marker_version = self._marker_version
        picture = self._picture
        if picture is not None and picture.frame_id == cursor.picture_id:
            picture = None
        elif picture is not None:
            cursor.picture_id = picture.frame_id
        size = self._frustum_size if self._frustum_size != cursor.frustum_size else None
        cursor.frustum_size = self._frustum_size
        return Changes(cleared, rows, segments, chunks, patches, truth, marker, picture, size)


def align_poses(T_from_cam: Array, T_to_cam: Array) -> tuple[float, Array, Array] | None:
    """Fit ``p_to = scale * R @ p_from + t`` to matched poses, the rotation from the cameras' directions.

    Unlike Umeyama's fit of positions alone this is also defined for a camera on a straight line.

    Returns:
        ``(scale, R, t)``, or None when the cameras don't move or move against each other.
    """
    if len(T_from_cam) < 2:
        return None
    R = project_to_so3(np.einsum("nij,nkj->ik", T_to_cam[:, :3, :3], T_from_cam[:, :3, :3]))
    p, q = T_from_cam[:, :3, 3] @ R.T, T_to_cam[:, :3, 3]
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    variance = float(((p - p_mean) ** 2).sum())
    scale = float(((p - p_mean) * (q - q_mean)).sum()) / variance if variance > 0 else 0.0
    if scale <= 0:
        return None
    return scale, R, q_mean - scale * p_mean
