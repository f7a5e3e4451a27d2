"""Poses of all frames of a run, each relative to a keyframe, as arrays that cost little to hand over.

A run of hours has many more frames than its map has keyframes: what is done with all of them at once, for
every checkpoint, must not go through them one by one.
"""

from collections.abc import Collection, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.track_ids import rows_among

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

_FIRST_CAPACITY = 256


class PosedFrames:
    """Frame id -> (keyframe's frame id, ``T_keyframe_cam``). A frame that is set again moves."""

    def __init__(self) -> None:
        self._row: dict[int, int] = {}
        self._ids: Ids = np.zeros(_FIRST_CAPACITY, np.int64)
        self._keyframe_ids: Ids = np.zeros(_FIRST_CAPACITY, np.int64)
        self._T_keyframe_cam: Array = np.zeros((_FIRST_CAPACITY, 4, 4))

    def __len__(self) -> int:
        return len(self._row)

    def __contains__(self, frame_id: object) -> bool:
        return frame_id in self._row

    def __iter__(self) -> Iterator[int]:
        return iter(self._row)

    def __getitem__(self, frame_id: int) -> tuple[int, Array]:
        row = self._row[frame_id]
        return int(self._keyframe_ids[row]), self._T_keyframe_cam[row].copy()

    def __setitem__(self, frame_id: int, pose: tuple[int, Array]) -> None:
        row = self._row.setdefault(frame_id, len(self._row))
        if row == len(self._ids):
            self._grow()
        self._ids[row] = frame_id
        self._keyframe_ids[row], self._T_keyframe_cam[row] = pose

    def _grow(self) -> None:
        """Double the room, so that adding frames costs the same however many there are."""
        self._ids = np.concatenate([self._ids, np.zeros_like(self._ids)])
        self._keyframe_ids = np.concatenate([self._keyframe_ids, np.zeros_like(self._keyframe_ids)])
        self._T_keyframe_cam = np.concatenate([self._T_keyframe_cam, np.zeros_like(self._T_keyframe_cam)])

    def keyframes(self) -> tuple[Ids, Ids]:
        """Return copies of ``ids (N,)`` ascending and ``keyframe_ids (N,)``."""
        order = self._in_order()
        return self._ids[order], self._keyframe_ids[order]

    def _in_order(self) -> NDArray[np.intp]:
        """Rows by ascending id."""
        return np.argsort(self._ids[: len(self)], kind="stable")

    def columns(self, ids: Ids | None = None) -> tuple[Ids, Ids, Array]:
        """Return copies of ``ids (N,)`` ascending, ``keyframe_ids (N,)`` and ``T_keyframe_cam (N, 4, 4)``.

        Args:
            ids: Only of these, in their order; None for all.
        """
        order = self._in_order() if ids is None else np.array([self._row[k] for k in ids.tolist()], np.intp)
        return self._ids[order], self._keyframe_ids[order], self._T_keyframe_cam[order]

    def take(self, ids: Ids, keyframe_ids: Ids, T_keyframe_cam: Array) -> None:
        """Take what ``columns`` gave, instead of all that is there.

        Raises:
            ValueError: The columns differ in length, or an id occurs twice.
        """
        count = len(ids)
        if keyframe_ids.shape != (count,) or T_keyframe_cam.shape != (count, 4, 4):
            raise ValueError(
                f"columns of {count} frames must be as long, got {len(keyframe_ids)} and "
                f"{len(T_keyframe_cam)}"
            )
        row = {frame_id: k for k, frame_id in enumerate(ids.tolist())}
        if len(row) != count:
            raise ValueError(f"ids of frames must differ, got {count - len(row)} twice")
        room = max(_FIRST_CAPACITY, 2 * count)
        self._row = row
        self._ids, self._keyframe_ids = np.zeros(room, np.int64), np.zeros(room, np.int64)
        self._T_keyframe_cam = np.zeros((room, 4, 4))
        self._ids[:count], self._keyframe_ids[:count] = ids, keyframe_ids
        self._T_keyframe_cam[:count] = T_keyframe_cam

    def forget(self, frame_ids: Collection[int]) -> None:
        """Take frames out; those that are not there are no error."""
        for frame_id in frame_ids:
            row = self._row.pop(frame_id, None)
            last = len(self._row)
            if row is None or row == last:
                continue
            # The last one takes its place: a video that repeats frames forgets one with each that is new.
            self._ids[row], self._keyframe_ids[row] = self._ids[last], self._keyframe_ids[last]
            self._T_keyframe_cam[row] = self._T_keyframe_cam[last]
            self._row[int(self._ids[row])] = row

    def rescale(self, factor: Mapping[int, float]) -> Ids:
        """Scale translations of frames by the frame id of their keyframe, and return whose have changed."""
        if not factor or not len(self):
            return np.zeros(0, np.int64)
        keyframe_ids = np.array(sorted(factor), dtype=np.int64)
        scale = np.array([factor[k] for k in keyframe_ids.tolist()])
        at = rows_among(self._keyframe_ids[: len(self)], keyframe_ids)
        each = np.where(at >= 0, scale[at], 1.0)
        self._T_keyframe_cam[: len(self), :3, 3] *= each[:, None]
        return np.asarray(self._ids[: len(self)][each != 1.0])
