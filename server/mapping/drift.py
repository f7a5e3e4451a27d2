"""How far keyframes may be off against the start of their part of the map: what adds up on the way.

An adjustment says how well its keyframes are known against the older ones that hold it, and those were known
no better against others when they were adjusted. A keyframe's covariance is that of its window, and behind
it that of the keyframes that held the window, carried to it: the scale goes with it, so that a length that
crept in lets the place drift for as long as the camera moves away. The first keyframes set the unit.
"""

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.mapping.bundle_problem import BundleResult
from semcast.server.mapping.guessed_place import carried

Array = NDArray[np.float64]


class Drift:
    """Covariances ``(7, 7)`` of a similarity in a keyframe's frame: turn, place, logarithm of the scale.

    That of the first keyframe of a part, which all others are told against, is zero. Others that were never
    adjusted have none.
    """

    def __init__(self) -> None:
        self._covariance: dict[int, Array] = {}

    def of(self, frame_id: int) -> Array | None:
        """Covariance of a keyframe; None without one."""
        return self._covariance.get(frame_id)

    def take(self, result: BundleResult) -> None:
        """Take what an adjustment says of its keyframes.

        Those that hold it count by how much they see of it; where nothing is known of one, the others count.
        Their errors are not independent, so that the mean of several is no better than one of them.
        """
        if result.covariances is None:
            return
        problem, T = result.problem, result.T_world_cam
        frame_ids = problem.keyframe_ids.tolist()
        held = np.flatnonzero(problem.fixed).tolist()
        count = np.bincount(problem.view, minlength=len(frame_ids))
        if problem.sets_unit:
            for k in held:
                self._covariance.setdefault(frame_ids[k], np.zeros((7, 7)))
        held = [k for k in held if frame_ids[k] in self._covariance]
        share = count[held] / max(int(count[held].sum()), 1)
        rows = np.flatnonzero(~problem.fixed).tolist()
        # All of it as one of the first keyframe, and from there to the others: each with each takes 10 ms.
        behind = np.zeros((7, 7))
        for k, s in zip(held, share.tolist(), strict=True):
            behind += s * _carried(self._covariance[frame_ids[k]], T[k], T[rows[0]])
        for row in rows:
            self._covariance[frame_ids[row]] = result.covariances[row] + _carried(behind, T[rows[0]], T[row])

    def rescale(self, factor: Mapping[int, float]) -> None:
        """Change the unit of length of keyframes: frame id -> factor on lengths."""
        for frame_id, f in factor.items():
            if frame_id in self._covariance:
                unit = np.repeat((1.0, f, 1.0), (3, 3, 1))
                self._covariance[frame_id] = self._covariance[frame_id] * np.outer(unit, unit)

    def follow(self, frame_ids: Collection[int], leader_id: int, poses: Mapping[int, Array]) -> None:
        """Keyframes were put in place by a keyframe of another part: what that one is off by, they are too.

        Args:
            frame_ids: Keyframes that follow.
            leader_id: The keyframe of the other part.
            poses: ``T_world_cam`` by frame id, where they are now.
        """
        leader = self._covariance.get(leader_id)
        if leader is None:
            return
        for frame_id in frame_ids:
            if frame_id in self._covariance:
                added = _carried(leader, poses[leader_id], poses[frame_id])
                self._covariance[frame_id] = self._covariance[frame_id] + added

    def close(
        self, since_id: int, until_id: int, frame_ids: Collection[int], poses: Mapping[int, Array]
    ) -> None:
        """A loop was closed: its last keyframe is known as well as its first, and more so the nearer to it.

        Args:
            since_id: Keyframe of the place the camera came back to.
            until_id: Keyframe that came back.
            frame_ids: Keyframes of the part it is in.
            poses: ``T_world_cam`` by frame id, where they are now.
        """
        first = self._covariance.get(since_id, np.zeros((7, 7)))
        loop = sorted(k for k in frame_ids if since_id < k <= until_id and k in self._covariance)
        for rank, frame_id in enumerate(loop, 1):
            known = rank / len(loop)
            mine = (1.0 - known) * self._covariance[frame_id]
            self._covariance[frame_id] = mine + known * _carried(first, poses[since_id], poses[frame_id])

    def keep(self, frame_ids: Collection[int]) -> None:
        """Forget all keyframes but these."""
        self._covariance = {k: self._covariance[k] for k in self._covariance.keys() & set(frame_ids)}

    def arrays(self) -> dict[str, NDArray]:
        """Return it as plain arrays, for a checkpoint."""
        frame_ids = sorted(self._covariance)
        covariances = [self._covariance[k] for k in frame_ids]
        return {
            "drift.frame_id": np.array(frame_ids, dtype=np.int64),
            "drift.covariance": np.array(covariances, dtype=np.float64).reshape(-1, 7, 7),
        }

    def restore(self, arrays: Mapping[str, NDArray]) -> None:
        """Take what ``arrays`` gave; older checkpoints have none."""
        frame_ids = arrays.get("drift.frame_id", np.zeros(0, np.int64)).tolist()
        covariances = np.array(arrays.get("drift.covariance", np.zeros((0, 7, 7))))
        self._covariance = dict(zip(frame_ids, covariances, strict=True))


def _carried(covariance: Array, T_world_from: Array, T_world_to: Array) -> Array:
    """Covariance ``(7, 7)`` of one camera as one of another camera, of poses ``(4, 4)`` in the world."""
    return carried(covariance, invert_transform(T_world_from) @ T_world_to)
