"""The camera's path, hung on keyframes that may move, in segments whose versions tell what to draw again."""

from bisect import bisect_left, insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform

Array = NDArray[np.float64]

SEGMENT_POSES = 32
#: Beyond it an eighth is left out, of the older half, where poses are closest.
MAX_POSES = 20_000


@dataclass
class _Posed:
    """A frame with a pose.

    Attributes:
        frame_id: Its index in its source.
        t_source_ns: Its recorded time.
        reference: Keyframe it moves with; -1 where there was none yet.
        T_ref_cam: 4x4 pose in that keyframe, in the world where that is not known.
        is_after_gap: The path is interrupted before it.
    """

    frame_id: int
    t_source_ns: int
    reference: int
    T_ref_cam: Array
    is_after_gap: bool


class PathTable:
    """Poses of frames by id, and of the keyframes they move with.

    There are ``MAX_POSES`` at most: of an endless path the newer half is complete, and the older one is
    thinned about evenly. Keyframes all stay, as the dense points of any of them may come at the end.

    Attributes:
        keyframes: Frame id to ``T_world_cam`` of keyframes.
        segment_versions: Of each segment of ``SEGMENT_POSES`` frames, how often it has changed.
    """

    def __init__(self) -> None:
        self._frames: list[_Posed] = []
        self._keyframe_ids: list[int] = []
        self._newest_keyframe = -1
        self.keyframes: dict[int, Array] = {}
        self.segment_versions: list[int] = []

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def frame_ids(self) -> NDArray[np.int64]:
        """``(N,)`` ids of the frames, ascending."""
        return np.array([frame.frame_id for frame in self._frames], dtype=np.int64)

    @property
    def newest_id(self) -> int:
        """Id of the last frame, -1 where there is none."""
        return self._frames[-1].frame_id if self._frames else -1

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """``(N,)`` recorded times of the frames."""
        return np.array([frame.t_source_ns for frame in self._frames], dtype=np.int64)

    @property
    def newest_centre(self) -> Array | None:
        """``(3,)`` where the camera was last, None where nothing is known of that."""
        if self._frames:
            return self.poses(len(self._frames) - 1)[0, :3, 3]
        known = self.keyframes.get(self._newest_keyframe)
        return None if known is None else known[:3, 3]

    def poses(self, start: int = 0, stop: int | None = None) -> Array:
        """Return ``T_world_cam`` ``(N, 4, 4)`` of the frames from place to place, after all corrections."""
        frames = self._frames[start:stop]
        if not frames:
            return np.zeros((0, 4, 4))
        identity = np.eye(4)
        T_world_ref = np.array([self.keyframes.get(frame.reference, identity) for frame in frames])
        return np.asarray(T_world_ref @ np.array([frame.T_ref_cam for frame in frames]))

    def insert(self, frame_id: int, t_source_ns: int, T_world_cam: Array, *, is_after_gap: bool) -> None:
        """Add a frame; one that is there stays as it is.

        Args:
            frame_id: Of the frame.
            t_source_ns: Its recorded time.
            T_world_cam: 4x4.
            is_after_gap: The camera was lost before it; where frames are behind it already, it was not.
        """
        place = self._place_of(frame_id)
        if place < len(self._frames) and self._frames[place].frame_id == frame_id:
            return
        reference = self._newest_keyframe
        if frame_id < reference:
            # Of a start: its frames move with the keyframe after them, as in the map.
            reference = self._keyframe_ids[bisect_left(self._keyframe_ids, frame_id)]
        T_ref_cam = self._in_keyframe(reference, T_world_cam)
        is_last = place == len(self._frames)
        self._frames.insert(
            place, _Posed(frame_id, t_source_ns, reference, T_ref_cam, is_after_gap and is_last)
        )
        self._touch_from(place)
        if len(self._frames) > MAX_POSES:
            self._thin_out()

    def _thin_out(self) -> None:
        """Leave out poses of the older half, never two next to each other."""
        ids = self.frame_ids[: MAX_POSES // 2 + 1]
        around = ids[2::2] - ids[:-2:2]  # how far apart the neighbours of every second one are
        closest = np.argsort(around, kind="stable")[: MAX_POSES // 8]
        self.withdraw(ids[1 + 2 * closest].tolist())

    def _place_of(self, frame_id: int) -> int:
        return bisect_left(self._frames, frame_id, key=lambda frame: frame.frame_id)

    def _in_keyframe(self, keyframe_id: int, T_world_cam: Array) -> Array:
        known = self.keyframes.get(keyframe_id)
        return T_world_cam if known is None else invert_transform(known) @ T_world_cam

    def move(self, T_world_cam: Mapping[int, Array]) -> None:
        """Set poses of frames, by id, that did not just move with a keyframe; unknown ones are no error."""
        for frame_id, T in T_world_cam.items():
            place = self._place_of(frame_id)
            if place < len(self._frames) and (frame := self._frames[place]).frame_id == frame_id:
                frame.T_ref_cam = self._in_keyframe(frame.reference, T)
        if T_world_cam:
            self._touch_from(0)

    def withdraw(self, frame_ids: Iterable[int]) -> None:
        """Take frames out whose pose was taken back; unknown ones are no error."""
        gone = set(frame_ids)
        places = [place for place, frame in enumerate(self._frames) if frame.frame_id in gone]
        for place in reversed(places):
            frame = self._frames.pop(place)
            if place < len(self._frames):
                self._frames[place].is_after_gap |= frame.is_after_gap
        if places:
            self._touch(range(places[0] // SEGMENT_POSES, len(self.segment_versions)))

    def set_keyframes(self, T_world_kf: Mapping[int, Array]) -> None:
        """Set poses of keyframes by frame id, 4x4; frames that hang on a moved one move with it."""
        moved: set[int] = set()
        for keyframe_id, T in T_world_kf.items():
            known = self.keyframes.get(keyframe_id)
            if known is None:
                insort(self._keyframe_ids, keyframe_id)
            elif not np.array_equal(known, T):
                moved.add(keyframe_id)
            self.keyframes[keyframe_id] = T
            self._newest_keyframe = max(self._newest_keyframe, keyframe_id)
        if moved:
            places = [place for place, frame in enumerate(self._frames) if frame.reference in moved]
            last = len(self._frames) - 1
            # The segment after a pose begins with it where it is the last one of its own.
            self._touch({min(k, last) // SEGMENT_POSES for place in places for k in (place, place + 1)})

    def _touch_from(self, place: int) -> None:
        self._touch(range(place // SEGMENT_POSES, (len(self._frames) - 1) // SEGMENT_POSES + 1))

    def _touch(self, segments: Iterable[int]) -> None:
        for segment in segments:
            while len(self.segment_versions) <= segment:
                self.segment_versions.append(0)
            self.segment_versions[segment] += 1

    def strips(self, segment: int) -> list[NDArray[np.float32]]:
        """Return the lines of one segment, each ``(n, 3)``; it starts at the last pose of the one before."""
        start = max(segment * SEGMENT_POSES - 1, 0)
        stop = max(min((segment + 1) * SEGMENT_POSES, len(self._frames)), start)
        positions = self.poses(start, stop)[:, :3, 3].astype(np.float32)
        cuts = [k for k in range(1, stop - start) if self._frames[start + k].is_after_gap]
        return [strip for strip in np.split(positions, cuts) if len(strip) > 1]
