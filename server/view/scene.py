"""What the viewer shows, kept as plain arrays: path, landmarks, truth, plots and the newest image.

The tracker moves old poses and landmarks whenever bundle adjustment ends. A scene remembers what each viewer
has already seen and hands out only what changed: the path in segments, the landmarks in chunks.
"""

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, project_to_so3
from semcast.common.sequence_layouts import ns_to_seconds
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import match_times
from semcast.server.dense.cloud import DensePatch
from semcast.server.view.landmark_table import LandmarkTable
from semcast.server.view.patch_table import PatchTable, PlacedPatch
from semcast.server.view.spectator import Spectator

Array = NDArray[np.float64]

SEGMENT_POSES = 32
#: Rows kept; of plot values a viewer that comes late, or stands still for so long, lacks those before.
MAX_ROWS = 20_000
MAX_KEYPOINTS = 1500
#: Depth of the drawn frustum as share of the median landmark distance.
FRUSTUM_SHARE = 0.15
#: From confidence 0 to 1 in equal steps; bright at both ends, for points on a dark background.
CONFIDENCE_COLOURS = ((165, 30, 75), (235, 95, 60), (250, 205, 90), (90, 220, 160), (40, 200, 220))


#: State of a frame of which no image came: it says nothing of the tracker.
MISSING = "missing"


@dataclass(frozen=True)
class FrameView:
    """What one processed frame contributes.

    Attributes:
        frame_id: Index of the frame in its source.
        t_source_ns: Recorded time of the frame.
        T_world_cam: 4x4, or None where the frame has no pose.
        state: Tracking state in words, or ``MISSING``.
        scalars: Plot path, such as ``link/snr_set_db``, to value.
        image: ``(H, W, 3)`` uint8 RGB as decoded; None once it was replaced by a newer one, or where the one
            before stays.
        confidence: ``(H, W)`` float32 in [0, 1], or None.
        keypoints_xy: ``(N, 2)`` pixels.
        keypoint_inlier: ``(N,)`` bool.
        backfilled: Poses found later for earlier frames: ``(frame_id, t_source_ns, T_world_cam)``.
    """

    frame_id: int
    t_source_ns: int
    T_world_cam: Array | None
    state: str
    scalars: dict[str, float]
    image: NDArray[np.uint8] | None
    confidence: NDArray[np.float32] | None
    keypoints_xy: NDArray[np.float32]
    keypoint_inlier: NDArray[np.bool_]
    backfilled: Sequence[tuple[int, int, Array]] = ()

    def without_image(self) -> "FrameView":
        """Return the light part: pose and plot values, all of which come into the scene."""
        none = np.zeros((0, 2), dtype=np.float32)
        return replace(
            self, image=None, confidence=None, keypoints_xy=none, keypoint_inlier=np.zeros(0, dtype=bool)
        )


@dataclass(frozen=True)
class Row:
    """One frame's place on the time axis, its pose and its plot values.

    Attributes:
        frame_id: Index of the frame in its source.
        t_source_ns: Recorded time of the frame.
        T_world_cam: 4x4, or None where the frame has no pose.
        T_world_eye: 4x4 of the spectator who follows the camera, None as ``T_world_cam``.
        scalars: Plot path to value.
    """

    frame_id: int
    t_source_ns: int
    T_world_cam: Array | None
    T_world_eye: Array | None
    scalars: dict[str, float]


@dataclass(frozen=True)
class Picture:
    """The newest image, compressed once for all viewers."""

    frame_id: int
    t_source_ns: int
    image_jpeg: bytes
    confidence_jpeg: bytes | None
    keypoints_xy: NDArray[np.float32]
    keypoint_inlier: NDArray[np.bool_]


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
        picture: The newest image, or None when unchanged.
        frustum_size: Distance of the drawn image plane in map units, or None when unchanged.
    """

    cleared: bool
    rows: list[Row]
    segments: dict[int, list[NDArray[np.float32]]]
    chunks: list[PointChunk]
    patches: list[PlacedPatch]
    truth: NDArray[np.float32] | None
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
        self._frame_ids: list[int] = []
        self._times_ns: list[int] = []
        self._references: list[int] = []
        self._breaks: list[bool] = []
        self._T_ref_cam: list[Array] = []
        self._keyframes: dict[int, Array] = {}
        self._keyframe_ids: list[int] = []
        #: What is known of each posed frame, in the order of the path.
        self._columns: tuple[list[Any], ...] = (
            self._frame_ids,
            self._times_ns,
            self._references,
            self._breaks,
            self._T_ref_cam,
        )
        self._newest_keyframe = -1
        self._lost_since_pose = False
        self._segment_versions: list[int] = []
        self._table = LandmarkTable()
        self._patches = PatchTable()
        self._truth_version = 0
        self._aligned: NDArray[np.float32] | None = None
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
        self._rows.append(Row(view.frame_id, view.t_source_ns, view.T_world_cam, T_world_eye, view.scalars))
        self._num_rows += 1
        for frame_id, t_source_ns, T_world_cam in view.backfilled:
            self._insert_pose(frame_id, t_source_ns, np.asarray(T_world_cam, dtype=np.float64))
        if view.T_world_cam is None:
            if view.state != MISSING:
                self._lost_since_pose = bool(self._frame_ids)
            return
        self._insert_pose(view.frame_id, view.t_source_ns, np.asarray(view.T_world_cam, dtype=np.float64))
        self._lost_since_pose = False

    def _insert_pose(self, frame_id: int, t_source_ns: int, T_world_cam: Array) -> None:
        place = bisect_left(self._frame_ids, frame_id)
        if place < len(self._frame_ids) and self._frame_ids[place] == frame_id:
            return
        reference = self._newest_keyframe
        if frame_id < reference:
            # Of a start: its frames move with the keyframe after them, as in the map.
            reference = self._keyframe_ids[bisect_left(self._keyframe_ids, frame_id)]
        self._frame_ids.insert(place, frame_id)
        self._times_ns.insert(place, t_source_ns)
        self._references.insert(place, reference)
        self._breaks.insert(place, self._lost_since_pose and place == len(self._breaks))
        self._T_ref_cam.insert(place, self._in_keyframe(reference, T_world_cam))
        self._touch_segments(range(place // SEGMENT_POSES, (len(self._frame_ids) - 1) // SEGMENT_POSES + 1))

    def _in_keyframe(self, keyframe_id: int, T_world_cam: Array) -> Array:
        known = self._keyframes.get(keyframe_id)
        return T_world_cam if known is None else invert_transform(known) @ T_world_cam

    def move_frames(self, ids: NDArray[np.int64], T_world_cam: Array) -> None:
        """Set the poses ``(F, 4, 4)`` of frames that did not just move with a keyframe."""
        for frame_id, T in zip(ids.tolist(), T_world_cam, strict=True):
            place = bisect_left(self._frame_ids, frame_id)
            if place < len(self._frame_ids) and self._frame_ids[place] == frame_id:
                self._T_ref_cam[place] = self._in_keyframe(self._references[place], T)
        if len(ids):
            self._touch_segments(range((len(self._frame_ids) - 1) // SEGMENT_POSES + 1))

    def withdraw_frames(self, ids: NDArray[np.int64]) -> None:
        """Take frames out of the path whose pose was taken back; unknown ones are no error."""
        places = np.flatnonzero(np.isin(np.array(self._frame_ids, dtype=np.int64), ids)).tolist()
        for place in reversed(places):
            is_break = self._breaks[place]
            for column in self._columns:
                del column[place]
            if is_break and place < len(self._breaks):
                self._breaks[place] = True
        if places:
            self._touch_segments(range(places[0] // SEGMENT_POSES, len(self._segment_versions)))

    def _touch_segments(self, indices: Sequence[int]) -> None:
        for k in indices:
            while len(self._segment_versions) <= k:
                self._segment_versions.append(0)
            self._segment_versions[k] += 1

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
        moved: set[int] = set()
        for keyframe_id, T in zip(ids.tolist(), np.asarray(T_world_kf, dtype=np.float64), strict=True):
            known = self._keyframes.get(keyframe_id)
            if known is not None and not np.array_equal(known, T):
                moved.add(keyframe_id)
            if known is None:
                insort(self._keyframe_ids, keyframe_id)
            self._keyframes[keyframe_id] = T
            self._newest_keyframe = max(self._newest_keyframe, keyframe_id)
        self._patches.place(self._keyframes, ids.tolist())
        if moved:
            touched = {k // SEGMENT_POSES for k, ref in enumerate(self._references) if ref in moved}
            self._touch_segments(sorted(touched))

    def set_patches(self, patches: Sequence[DensePatch]) -> None:
        """Add or replace the dense points of keyframes."""
        for patch in patches:
            self._patches.add(patch)
        self._patches.place(self._keyframes, [patch.frame_id for patch in patches])

    def set_picture(self, picture: Picture) -> None:
        """Replace the newest image."""
        self._picture = picture

    def poses(self, start: int = 0, stop: int | None = None) -> Array:
        """Return ``T_world_cam`` ``(N, 4, 4)`` of posed frames by place, after all corrections."""
        if not self._frame_ids[start:stop]:
            return np.zeros((0, 4, 4))
        identity = np.eye(4)
        T_world_ref = np.array([self._keyframes.get(k, identity) for k in self._references[start:stop]])
        return np.asarray(T_world_ref @ np.array(self._T_ref_cam[start:stop]))

    def align_truth(self) -> None:
        """Fit the truth to the path anew; a no-op while the path is too short to fit."""
        if self._truth is None or len(self._frame_ids) < 3:
            return
        times_ns = np.array(self._times_ns, dtype=np.int64)
        if self._truth_times_ns is not None:
            # Frames of a later pass have no time there.
            num_timed = bisect_left(self._frame_ids, len(self._truth_times_ns))
            times_ns = self._truth_times_ns[self._frame_ids[:num_timed]]
        place, truth_idx = match_times(ns_to_seconds(times_ns), self._truth.t_s)
        fit = align_poses(self._truth.T_world_cam[truth_idx], self.poses()[place])
        if fit is None:
            return
        scale, R, t = fit
        self._aligned = (scale * self._truth.positions @ R.T + t).astype(np.float32)
        self._truth_version += 1

    def _measure(self) -> None:
        """Take the scene's size from the landmarks around the camera; a frustum follows it in steps."""
        if self._frame_ids:
            centre = self.poses(len(self._frame_ids) - 1)[0, :3, 3]
        elif self._keyframes:
            centre = self._keyframes[self._newest_keyframe][:3, 3]
        else:
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
            cursor.frustum_size = 0.0
            cursor.generation = self._generation
        missing = min(self._num_rows - cursor.num_rows, len(self._rows))
        rows = [self._rows[k] for k in range(len(self._rows) - missing, len(self._rows))]
        cursor.num_rows = self._num_rows
        segments = {}
        for k, version in enumerate(self._segment_versions):
            if cursor.segments.get(k) != version:
                cursor.segments[k] = version
                segments[k] = self._strips(k)
        chunks = []
        for k, version in enumerate(self._table.chunk_versions):
            if cursor.chunks.get(k) != version:
                cursor.chunks[k] = version
                chunks.append(PointChunk(k, *self._table.chunk(k)))
        patches = self._patches.changes_since(cursor.patches)
        truth = self._aligned if cursor.truth_version != self._truth_version else None
        cursor.truth_version = self._truth_version
        picture = self._picture
        if picture is not None and picture.frame_id == cursor.picture_id:
            picture = None
        elif picture is not None:
            cursor.picture_id = picture.frame_id
        size = self._frustum_size if self._frustum_size != cursor.frustum_size else None
        cursor.frustum_size = self._frustum_size
        return Changes(cleared, rows, segments, chunks, patches, truth, picture, size)

    def _strips(self, segment: int) -> list[NDArray[np.float32]]:
        """Line strips of one segment; it starts at the last pose of the one before."""
        start = max(segment * SEGMENT_POSES - 1, 0)
        stop = max(min((segment + 1) * SEGMENT_POSES, len(self._frame_ids)), start)
        positions = self.poses(start, stop)[:, :3, 3].astype(np.float32)
        cuts = [k for k in range(1, stop - start) if self._breaks[start + k]]
        return [strip for strip in np.split(positions, cuts) if len(strip) > 1]


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


def compress_picture(view: FrameView, quality: int) -> Picture:
    """Compress a frame's image and colour-mapped confidence to JPEG and thin out its keypoints.

    Raises:
        ValueError: The view has no image.
    """
    if view.image is None:
        raise ValueError(f"frame {view.frame_id} must have an image")
    bgr = cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    image_jpeg = cv2.imencode(".jpg", bgr, options)[1].tobytes()
    confidence_jpeg = None
    if view.confidence is not None:
        heat = cv2.cvtColor(confidence_colours(view.confidence), cv2.COLOR_RGB2BGR)
        confidence_jpeg = cv2.imencode(".jpg", heat, options)[1].tobytes()
    step = -(-max(len(view.keypoints_xy), 1) // MAX_KEYPOINTS)
    return Picture(
        view.frame_id,
        view.t_source_ns,
        image_jpeg,
        confidence_jpeg,
        view.keypoints_xy[::step],
        view.keypoint_inlier[::step],
    )


def confidence_colours(confidence: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colour confidences of any shape: red is not trusted, yellow half, turquoise fully; NaN counts as 0.

    Returns:
        uint8 RGB with one more axis, of length 3.
    """
    levels = (np.clip(np.nan_to_num(confidence, nan=0.0), 0.0, 1.0) * 255.0).astype(np.uint8)
    stops = np.linspace(0.0, 255.0, len(CONFIDENCE_COLOURS))
    table = np.stack(
        [np.interp(np.arange(256), stops, channel) for channel in np.transpose(CONFIDENCE_COLOURS)], axis=1
    )
    return np.asarray(np.rint(table).astype(np.uint8)[levels], dtype=np.uint8)
