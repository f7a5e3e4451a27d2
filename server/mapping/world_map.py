"""The map: landmarks, keyframes with their observations and the frames between them, bounded in size."""

from bisect import bisect_left
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.edges import alike, each_of
from semcast.server.mapping.drift import Drift
from semcast.server.mapping.guessed_place import GuessedPlace, guesses_as_arrays, guesses_of
from semcast.server.mapping.landmarks import Landmarks
from semcast.server.mapping.map_arrays import check_map_arrays
from semcast.server.mapping.posed_frames import PosedFrames
from semcast.server.mapping.thinning import evenly_thinned, gaps_among, hung_on_what_is_left, least_needed

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Observations in a row that disagree before a landmark is given up.
_MAX_MISSED = 4


@dataclass
class Keyframe:
    """A keyframe: a frame whose observations the map is made from.

    Attributes:
        frame_id: Of the frame.
        t_source_ns: Of the frame.
        T_world_cam: ``(4, 4)``, moved by bundle adjustment.
        submap: Which part of the map it belongs to.
        ids: ``(M,)`` int64 tracks seen, ascending.
        xy: ``(M, 2)`` where.
        confidence: ``(M,)`` of each observation.
        descriptor_ids: ``(D,)`` int64 tracks that have a descriptor.
        descriptors: ``(D, 32)`` uint8.
        refuted: ``(R,)`` int64 tracks seen that no point at rest explains, ascending.
        edge: ``(M, 2)`` of each observation, see ``edges``.
    """

    frame_id: int
    t_source_ns: int
    T_world_cam: Array
    submap: int
    ids: Ids
    xy: Array
    confidence: Array
    descriptor_ids: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    descriptors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 32), np.uint8))
    refuted: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    edge: Array = field(default_factory=alike)

    def __post_init__(self) -> None:
        """Have an edge for each observation."""
        self.edge = each_of(self.edge, len(self.ids))

    def drop_observations(self, bad: NDArray[np.bool_]) -> None:
        """Forget the observations in the mask."""
        self.ids, self.xy, self.confidence = self.ids[~bad], self.xy[~bad], self.confidence[~bad]
        self.edge = self.edge[~bad]


_KEYFRAME_PARTS = ("ids", "xy", "confidence", "descriptor_ids", "descriptors")


class MapChanges(NamedTuple):
    """Ids of what has changed in a map, each ascending.

    Attributes:
        landmarks: Those added or moved.
        removed: Landmarks that are gone.
        keyframes: Frame ids of those added or moved; frames move with their keyframe without being named.
        frames: Frames that moved otherwise.
        withdrawn: Frames whose pose was taken back.
    """

    landmarks: Ids
    removed: Ids
    keyframes: Ids
    frames: Ids
    withdrawn: Ids


class WorldMap:
    """Landmarks, keyframes and the poses of all frames relative to keyframes.

    Attributes:
        landmarks: The points.
        keyframes: By frame id, ascending, those with observations.
        poses: Frame id of a keyframe -> ``T_world_cam``, also of keyframes thinned out since.
        submap_of: Frame id of a keyframe -> its submap.
        frames: Of each its keyframe and ``T_keyframe_cam``.
        revisits: Frame id of a keyframe -> that of an older one whose landmarks it saw again.
        gaps: Frame ids of keyframes behind a gap in the tracks, noted when keyframes are thinned out.
        guesses: Submap whose place in the world was guessed -> what that is worth, until it is moved.
        drift: How far keyframes may be off against the start of their part.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.landmarks = Landmarks()
        self.keyframes: list[Keyframe] = []
        self.poses: dict[int, Array] = {}
        self.submap_of: dict[int, int] = {}
        self.frames = PosedFrames()
        self.revisits: dict[int, int] = {}
        self.gaps: set[int] = set()
        self.guesses: dict[int, GuessedPlace] = {}
        self.drift = Drift()
        self._changed: set[int] = set()
        self._moved_keyframes: set[int] = set()
        self._frames_moved: set[int] = set()
        self._removed: set[int] = set()
        self._withdrawn: set[int] = set()

    def keyframe(self, frame_id: int) -> Keyframe | None:
        """Keyframe with a frame id; None where there is none, or it was thinned out."""
        at = bisect_left(self.keyframes, frame_id, key=lambda k: k.frame_id)
        found = self.keyframes[at] if at < len(self.keyframes) else None
        return found if found is not None and found.frame_id == frame_id else None

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Append a keyframe."""
        self.keyframes.append(keyframe)
        self.poses[keyframe.frame_id] = keyframe.T_world_cam
        self.submap_of[keyframe.frame_id] = keyframe.submap
        self.frames[keyframe.frame_id] = (keyframe.frame_id, np.eye(4))
        self._moved_keyframes.add(keyframe.frame_id)

    def add_landmarks(
        self,
        ids: Ids,
        xyz: Array,
        rgb: NDArray[np.uint8],
        confidence: NDArray,
        submap: int,
        frame_id: int | Ids,
    ) -> None:
        """Add new landmarks and note the change."""
        self.landmarks.add(ids, xyz, rgb, confidence, submap, frame_id)
        self._changed.update(ids.tolist())

    def move_landmarks(self, ids: Ids, xyz: Array) -> None:
        """Set positions of landmarks that are still there."""
        row = self.landmarks.rows(ids)
        there = row >= 0
        self.landmarks.xyz[row[there]] = xyz[there]
        self._changed.update(ids[there].tolist())

    def remove_landmarks(self, bad: NDArray[np.bool_]) -> None:
        """Forget the landmarks in the mask over rows."""
        if bad.any():
            self._removed.update(self.landmarks.ids[bad].tolist())
            self.landmarks.keep(~bad)

    def note_sight(self, ids: Ids, agrees: NDArray[np.bool_], frame_id: int) -> None:
        """Note which landmarks a frame saw and which agreed with its pose; those that keep disagreeing go.

        Args:
            ids: ``(N,)`` landmarks the frame saw; those that are not there any more are passed over.
            agrees: ``(N,)`` which agree with its pose.
            frame_id: The frame.
        """
        row = self.landmarks.rows(ids)
        there = row >= 0
        row, agrees = row[there], agrees[there]
        self.landmarks.last_seen[row[agrees]] = frame_id
        self.landmarks.num_missed[row[agrees]] = 0
        self.landmarks.num_missed[row[~agrees]] += 1
        self.remove_landmarks(self.landmarks.num_missed >= _MAX_MISSED)

    def move_keyframe(self, frame_id: int, T_world_cam: Array) -> None:
        """Set the pose of a keyframe, thinned out or not."""
        if frame_id in self.poses:
            self.poses[frame_id] = T_world_cam
            self._moved_keyframes.add(frame_id)
            keyframe = self.keyframe(frame_id)
            if keyframe is not None:
                keyframe.T_world_cam = T_world_cam

    def add_frame(self, frame_id: int, keyframe_id: int, T_world_cam: Array) -> None:
        """Note a frame's pose relative to a keyframe, with which it then moves.

        Raises:
            KeyError: There is no such keyframe.
        """
        self.frames[frame_id] = (keyframe_id, invert_transform(self.poses[keyframe_id]) @ T_world_cam)

    def move_frame(self, frame_id: int, T_world_cam: Array) -> None:
        """Set the pose of a frame that has one; it goes on to move with the same keyframe.

        Raises:
            KeyError: It has none.
        """
        self.add_frame(frame_id, self.frames[frame_id][0], T_world_cam)
        self._frames_moved.add(frame_id)

    def forget_frames(self, frame_ids: Collection[int]) -> None:
        """Take the pose from frames; keyframes among them stay for what they see."""
        self._withdrawn.update(frame_ids)
        self.frames.forget(frame_ids)

    def keyframes_of(self, submap: int) -> list[Keyframe]:
        """Keyframes of a submap, in order of time."""
        return [k for k in self.keyframes if k.submap == submap]

    def transform_submap(self, submap: int, into: int, scale: float, T_new_old: Array) -> None:
        """Move a submap by a similarity ``x' = T (s x)`` and make it part of another.

        What a guess of its place was worth is forgotten: another guess is worth something else.

        Args:
            submap: The one that moves: landmarks, keyframes and frames.
            into: The one it becomes part of.
            scale: Units of the other in one of its own.
            T_new_old: ``(4, 4)``.
        """
        self.guesses.pop(submap, None)
        mine = self.landmarks.submap == submap
        xyz = scale * self.landmarks.xyz[mine]
        self.landmarks.xyz[mine] = transform_points(T_new_old, xyz)
        self.landmarks.submap[mine] = into
        self._changed.update(self.landmarks.ids[mine].tolist())
        moved = {k for k, s in self.submap_of.items() if s == submap}
        for frame_id in moved:
            T = self.poses[frame_id].copy()
            T[:3, 3] *= scale
            self.poses[frame_id] = T_new_old @ T
            self.submap_of[frame_id] = into
        self._moved_keyframes.update(moved)
        for keyframe in self.keyframes_of(submap):
            keyframe.T_world_cam, keyframe.submap = self.poses[keyframe.frame_id], into
        self._rescale(dict.fromkeys(moved, scale))
        self._frames_moved.update(self.frames)

    def bend(self, keyframe_ids: Ids, T_world_cam: Array, scale: Array) -> None:
        """Move keyframes of one submap, each with its landmarks and frames, scaled.

        Keyframes that were thinned out move with the one before them.

        Args:
            keyframe_ids: ``(K,)`` frame ids, ascending.
            T_world_cam: ``(K, 4, 4)`` their new poses.
            scale: ``(K,)`` factor on lengths around each.
        """
        submap = self.submap_of[int(keyframe_ids[0])]
        T_cam_world = invert_transform(np.stack([self.poses[k] for k in keyframe_ids.tolist()]))
        mine = self.landmarks.submap == submap
        at = _at_or_before(keyframe_ids, self.landmarks.born[mine])
        around = np.einsum("nij,nj->ni", T_cam_world[at, :3, :3], self.landmarks.xyz[mine])
        around = scale[at, None] * (around + T_cam_world[at, :3, 3])
        moved = np.einsum("nij,nj->ni", T_world_cam[at, :3, :3], around) + T_world_cam[at, :3, 3]
        self.landmarks.xyz[mine] = moved
        self._changed.update(self.landmarks.ids[mine].tolist())
        frame_ids = np.array([k for k, s in self.submap_of.items() if s == submap], dtype=np.int64)
        at = _at_or_before(keyframe_ids, frame_ids)
        T = T_cam_world[at] @ np.stack([self.poses[k] for k in frame_ids.tolist()])
        T[:, :3, 3] *= scale[at, None]
        self.poses.update(zip(frame_ids.tolist(), T_world_cam[at] @ T, strict=True))
        self._moved_keyframes.update(frame_ids.tolist())
        for keyframe in self.keyframes:
            keyframe.T_world_cam = self.poses[keyframe.frame_id]
        self._rescale(dict(zip(frame_ids.tolist(), scale[at].tolist(), strict=True)))
        self._frames_moved.update(self.frames)

    def _rescale(self, factor: dict[int, float]) -> None:
        """Take over another unit of length in what is told relative to keyframes."""
        self.rescale_frames(factor)
        self.drift.rescale(factor)

    def rescale_frames(self, factor: dict[int, float]) -> None:
        """Scale the poses of frames relative to keyframes."""
        self._frames_moved.update(self.frames.rescale(factor).tolist())

    def bound(self, max_landmarks: int, max_keyframes: int, recent: int) -> bool:
        """Keep the map within its size: some landmarks and old keyframes go everywhere, see ``thinning``.

        Args:
            max_landmarks: Landmarks at most.
            max_keyframes: Keyframes at most.
            recent: So many of the newest keyframes stay, one at least.

        Returns:
            Whether keyframes went.
        """
        excess = len(self.landmarks) - max_landmarks
        if excess > 0:
            # A tenth more than needed, so that this does not run on every keyframe.
            count = min(len(self.landmarks), excess + max_landmarks // 10)
            seen = [rows[rows >= 0] for rows in (self.landmarks.rows(k.ids) for k in self.keyframes)]
            since = self.keyframes[-recent:][0].frame_id if self.keyframes else 0
            bad = np.zeros(len(self.landmarks), bool)
            bad[least_needed(seen, self.landmarks.last_seen, since, count)] = True
            self.remove_landmarks(bad)
        if len(self.keyframes) <= max_keyframes:
            return False
        old, young = self.keyframes[:-recent], self.keyframes[-recent:]
        self.gaps |= gaps_among(self.keyframes, self.submap_of)
        kept = evenly_thinned(np.array([k.frame_id for k in old]), len(old) // 2)
        self.keyframes = [old[row] for row in kept.tolist()] + young
        self.revisits = hung_on_what_is_left(self.revisits, self.keyframes, self.submap_of)
        self.drift.keep({k.frame_id for k in self.keyframes})
        return True

    def submap_of_frame(self, frame_id: int | None) -> int | None:
        """Part of the map a frame is in, None without a pose."""
        if frame_id is None or frame_id not in self.frames:
            return None
        return self.submap_of[self.frames[frame_id][0]]

    def pose_of_frame(self, frame_id: int) -> Array | None:
        """Best current ``T_world_cam`` of a frame, None where it has none."""
        if frame_id not in self.frames:
            return None
        keyframe_id, T_keyframe_cam = self.frames[frame_id]
        return np.asarray(self.poses[keyframe_id] @ T_keyframe_cam)

    def poses_of_frames(self, frame_ids: Ids | None = None) -> tuple[Ids, Array]:
        """Return ids and the best current ``T_world_cam (N, 4, 4)`` of frames: all, ascending, or these."""
        ids, keyframe_ids, T_keyframe_cam = self.frames.columns(frame_ids)
        if len(ids) == 0:
            return ids, T_keyframe_cam
        used, at = np.unique(keyframe_ids, return_inverse=True)
        return ids, np.stack([self.poses[k] for k in used.tolist()])[at] @ T_keyframe_cam

    def trajectory(self) -> dict[int, Array]:
        """Best current ``T_world_cam`` of every posed frame, by frame id ascending."""
        ids, T_world_cam = self.poses_of_frames()
        return dict(zip(ids.tolist(), T_world_cam, strict=True))

    def part_of_frames(self) -> dict[int, int]:
        """Posed frame id, ascending, -> the submap its keyframe is in now, whatever it was tracked in."""
        ids, keyframe_ids = self.frames.keyframes()
        submaps = (self.submap_of[k] for k in keyframe_ids.tolist())
        return dict(zip(ids.tolist(), submaps, strict=True))

    def observations(self) -> tuple[Ids, Ids, Array]:
        """Landmark id, keyframe's frame id and pixel of every observation of a landmark."""
        ids, frames, xy = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
        for keyframe in self.keyframes:
            seen = self.landmarks.rows(keyframe.ids) >= 0
            ids.append(keyframe.ids[seen])
            frames.append(np.full(int(seen.sum()), keyframe.frame_id, np.int64))
            xy.append(keyframe.xy[seen])
        return np.concatenate(ids), np.concatenate(frames), np.concatenate(xy)

    def take_changes(self) -> MapChanges:
        """Return what has changed since this was last called."""
        removed = np.array(sorted(self._removed), dtype=np.int64)
        removed = removed[self.landmarks.rows(removed) < 0]
        changed = np.array(sorted(self._changed), dtype=np.int64)
        changed = changed[self.landmarks.rows(changed) >= 0]
        moved = np.array(sorted(self._moved_keyframes), dtype=np.int64)
        frames = np.array(sorted(k for k in self._frames_moved if k in self.frames), dtype=np.int64)
        withdrawn = np.array(sorted(k for k in self._withdrawn if k not in self.frames), dtype=np.int64)
        self._changed, self._removed, self._moved_keyframes = set(), set(), set()
        self._frames_moved, self._withdrawn = set(), set()
        return MapChanges(changed, removed, moved, frames, withdrawn)

    def everything(self) -> MapChanges:
        """All landmarks and keyframes, as if they had changed."""
        keyframes, none = np.array(sorted(self.poses), dtype=np.int64), np.zeros(0, np.int64)
        return MapChanges(self.landmarks.ids.copy(), none, keyframes, frames=none, withdrawn=none)

    def arrays(self) -> dict[str, NDArray]:
        """All as plain arrays, for a checkpoint, but the refuted tracks, which end with the process."""
        lengths = [[len(getattr(k, part)) for part in _KEYFRAME_PARTS] for k in self.keyframes]
        frame_ids, keyframe_ids, T_keyframe_cam = self.frames.columns()
        posed = sorted(self.poses)
        return {
            **self.landmarks.arrays(),
            "keyframes.frame_id": np.array([k.frame_id for k in self.keyframes], dtype=np.int64),
            "keyframes.t_source_ns": np.array([k.t_source_ns for k in self.keyframes], dtype=np.int64),
            "keyframes.length": np.array(lengths, dtype=np.int64).reshape(-1, len(_KEYFRAME_PARTS)),
            **{
                f"keyframes.{p}": _joined([getattr(k, p) for k in self.keyframes], p) for p in _KEYFRAME_PARTS
            },
            "keyframes.edge": np.concatenate([np.zeros((0, 2)), *(k.edge for k in self.keyframes)]),
            "poses.frame_id": np.array(posed, dtype=np.int64),
            "poses.T_world_cam": np.array([self.poses[k] for k in posed]).reshape(-1, 4, 4),
            "poses.submap": np.array([self.submap_of[k] for k in posed], dtype=np.int64),
            "frames.frame_id": frame_ids,
            "frames.keyframe_id": keyframe_ids,
            "frames.T_keyframe_cam": T_keyframe_cam,
            "revisits": np.array(list(self.revisits.items()), dtype=np.int64).reshape(-1, 2),
            "gaps": np.array(sorted(self.gaps), dtype=np.int64),
            **guesses_as_arrays(self.guesses),
            **self.drift.arrays(),
        }

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take what ``arrays`` gave.

        Raises:
            KeyError: An array is missing.
            ValueError: Arrays contradict each other.
        """
        check_map_arrays(arrays, _KEYFRAME_PARTS)
        self._clear()
        self.landmarks.restore(arrays)
        for frame_id, T, submap in zip(
            arrays["poses.frame_id"].tolist(),
            arrays["poses.T_world_cam"],
            arrays["poses.submap"],
            strict=True,
        ):
            self.poses[frame_id], self.submap_of[frame_id] = np.array(T), int(submap)
        self.frames.take(
            arrays["frames.frame_id"], arrays["frames.keyframe_id"], arrays["frames.T_keyframe_cam"]
        )
        ends = np.cumsum(arrays["keyframes.length"], axis=0)
        starts = ends - arrays["keyframes.length"]
        # Older checkpoints have no edges.
        edges = arrays.get("keyframes.edge", np.zeros_like(arrays["keyframes.xy"]))
        for k, frame_id in enumerate(arrays["keyframes.frame_id"].tolist()):
            parts = {
                part: np.array(arrays[f"keyframes.{part}"][starts[k, j] : ends[k, j]])
                for j, part in enumerate(_KEYFRAME_PARTS)
            }
            self.keyframes.append(
                Keyframe(
                    frame_id=frame_id,
                    t_source_ns=int(arrays["keyframes.t_source_ns"][k]),
                    T_world_cam=self.poses[frame_id],
                    submap=self.submap_of[frame_id],
                    edge=np.array(edges[starts[k, 0] : ends[k, 0]]),
                    **parts,
                )
            )
        there = {k.frame_id for k in self.keyframes}
        revisits = arrays.get("revisits", np.zeros((0, 2), np.int64))  # older checkpoints have none
        self.revisits = {new: old for new, old in revisits.tolist() if {new, old} <= there}
        self.gaps = set(arrays.get("gaps", np.zeros(0, np.int64)).tolist())
        self.guesses = guesses_of(arrays)
        self.drift.restore(arrays)
        self._changed = set(self.landmarks.ids.tolist())
        self._moved_keyframes = set(self.poses)


def _at_or_before(keyframe_ids: Ids, frame_ids: Ids) -> NDArray[np.intp]:
    """Row of the last keyframe not after each frame, the first one for frames before all of them."""
    return np.maximum(np.searchsorted(keyframe_ids, frame_ids, side="right") - 1, 0)


def _joined(parts: Iterable[NDArray], name: str) -> NDArray:
    empty = {
        "ids": np.zeros(0, np.int64),
        "xy": np.zeros((0, 2)),
        "confidence": np.zeros(0),
        "descriptor_ids": np.zeros(0, np.int64),
        "descriptors": np.zeros((0, 32), np.uint8),
    }[name]
    return np.concatenate([empty, *parts])
