"""Follows the map: chooses whose depth is estimated from which neighbours, and what of it becomes points."""

import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.dense.cloud import CloudPoints, DenseCloud, DensePatch, landmark_depths, scale_since
from semcast.server.dense.consistency import OtherDepth, added_points, confirmed_by
from semcast.server.dense.depth_map import DepthMap, DepthProblem
from semcast.server.dense.neighbours import (
    NUM_CONFIRMING,
    NUM_COVERING,
    NUM_NEIGHBOURS,
    DepthRange,
    choose_neighbours,
    confirming,
    depth_problem,
    depth_range,
)
from semcast.server.dense.view import View, view_of
from semcast.server.mapping.world_map import Keyframe, WorldMap
from semcast.server.worker import Runner

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: The newest keyframes whose images are kept,
_NUM_VIEWS = 12
#: and those whose depth maps are.
_NUM_MAPS = 8
#: Images kept where depth is estimated at the end: half a megabyte each. Beyond it every second one goes.
_NUM_STORED = 300
#: Depths that are off by a larger share than this, since the unit has changed, are left out.
_SCALE_CHANGE = 0.01
_POLL_S = 0.01
#: Later keyframes that are waited for: after them, those that are there have to do.
_MAX_LATER = 4
#: Keyframes that may wait where there is no time for all.
_MAX_WAITING = 2


#: Estimates depth maps.
DepthRunner = Runner[DepthProblem, DepthMap]


class DenseBuilder:
    """Makes the dense cloud of a map while that grows.

    Args:
        camera: Of the images, without distortion.
        runner: Estimates depth; closed with the builder.
        lossless: Every keyframe gets its depth, if need be by waiting for it; otherwise those do for which
            there is time.
        at_end: Depth is not estimated before the stream has ended.
    """

    def __init__(
        self, camera: Intrinsics, runner: DepthRunner, *, lossless: bool = False, at_end: bool = False
    ) -> None:
        self._camera = camera
        self._runner = runner
        self._lossless = lossless
        self._at_end = at_end
        self.reset()

    def reset(self) -> None:
        """Forget everything: the map was begun anew."""
        self._kept: dict[int, View] = {}
        self._waiting: list[int] = []
        self._maps: dict[int, DepthMap] = {}
        self._unconfirmed: list[int] = []
        self._confirmed: dict[int, DepthMap] = {}
        #: What landmarks said when depth was asked for, to notice another scale since.
        self._landmarks: dict[int, tuple[Ids, Array]] = {}
        self._cloud = DenseCloud()

    def add_keyframe(
        self, frame_id: int, image: NDArray[np.uint8], confidence: NDArray[np.float32] | None
    ) -> None:
        """Take the image of a new keyframe.

        Args:
            frame_id: Of the keyframe, newer than those before.
            image: ``(H, W, 3)`` uint8 RGB.
            confidence: ``(H, W)`` in [0, 1], the codec's pixel target; None counts as 1.
        """
        self._kept[frame_id] = view_of(frame_id, image, confidence, self._camera)
        self._waiting.append(frame_id)
        if not self._at_end:
            self._keep(sorted(self._kept)[-_NUM_VIEWS:])

    def advance(self, world: WorldMap) -> None:
        """Take a depth map that is ready and begin on another; returns at once where nothing may be lost.

        Args:
            world: The map as it is.
        """
        if not self._at_end:
            self._take(world, wait=self._lossless)
            self._begin(world, is_last=False)
        elif len(self._kept) > _NUM_STORED:
            there = {k.frame_id for k in world.keyframes}
            kept = [k for k in sorted(self._kept) if k in there]
            self._keep([*kept[:-1:2], kept[-1]] if len(kept) > _NUM_STORED else kept)

    def _keep(self, frame_ids: list[int]) -> None:
        """Forget the images of all other keyframes."""
        self._kept = {k: self._kept[k] for k in frame_ids}
        self._waiting = [k for k in self._waiting if k in self._kept]

    def follow(self, world: WorldMap, frame_ids: Sequence[int]) -> None:
        """Note keyframes that the map has moved; depths in units of before are of no use any more."""
        self._cloud.follow(world, frame_ids)
        if any(self._has_other_scale(k, world) for k in frame_ids if k in self._maps):
            self._maps, self._confirmed, self._unconfirmed = {}, {}, []

    def withdraw(self, frame_ids: Sequence[int]) -> None:
        """Take away the points of keyframes whose pose was taken back."""
        self._cloud.withdraw(frame_ids)

    def _has_other_scale(self, frame_id: int, world: WorldMap) -> bool:
        scale = scale_since(world, frame_id, *self._landmarks[frame_id])
        return scale is not None and abs(scale - 1.0) > _SCALE_CHANGE

    def finish(self, world: WorldMap, budget_s: float | None = None) -> Iterator[tuple[DensePatch, ...]]:
        """Make points of what is there, for the stream has ended, and yield after each depth map what is new.

        Args:
            world: The map as it is.
            budget_s: What is not estimated by then is left out; None waits for all.
        """
        end_s = None if budget_s is None else time.monotonic() + budget_s
        while end_s is None or time.monotonic() < end_s:
            self._take(world, wait=end_s is None)
            self._begin(world, is_last=True)
            if not self._runner.busy:
                break
            changes = self.take_changes()
            if changes or end_s is None:
                yield changes
            else:
                time.sleep(_POLL_S)
        while self._unconfirmed:
            self._confirm(self._unconfirmed.pop(0), world)
        yield self.take_changes()

    @property
    def num_waiting(self) -> int:
        """Keyframes whose depth may still be estimated, the one at work among them."""
        return len(self._waiting) + self._runner.busy

    def take_changes(self) -> tuple[DensePatch, ...]:
        """Return patches that were added or changed since this was last called."""
        return self._cloud.take_changes()

    def points(self, world: WorldMap) -> CloudPoints:
        """Return the cloud as it is."""
        return self._cloud.points(world)

    def close(self) -> None:
        """End the runner. Idempotent."""
        self._runner.close()

    def _take(self, world: WorldMap, *, wait: bool) -> None:
        found = self._runner.take(wait=wait) if self._runner.busy else None
        if found is None or found.frame_id not in self._kept or self._has_other_scale(found.frame_id, world):
            return
        self._maps[found.frame_id] = found
        self._unconfirmed.append(found.frame_id)
        for old in sorted(self._maps)[:-_NUM_MAPS]:
            del self._maps[old]
        # The newest wait for those after them.
        self._unconfirmed = sorted(k for k in self._unconfirmed if k in self._maps)
        while len(self._unconfirmed) > NUM_CONFIRMING:
            self._confirm(self._unconfirmed.pop(0), world)

    def _begin(self, world: WorldMap, *, is_last: bool) -> None:
        """Give the runner the oldest keyframe that has its neighbours."""
        if self._runner.busy:
            return
        if not self._lossless and not is_last:
            ready = [k for k in self._waiting if self._is_ready(k, world)]
            self._waiting = [k for k in self._waiting if k not in ready[:-_MAX_WAITING]]
        for frame_id in list(self._waiting):
            if not is_last and not self._is_ready(frame_id, world):
                return
            self._waiting.remove(frame_id)
            keyframe = world.keyframe(frame_id)
            if keyframe is None or world.pose_of_frame(frame_id) is None:
                continue
            seen = landmark_depths(world, keyframe)
            problem = self._problem(keyframe, depth_range(seen[1]), world)
            if problem is not None:
                self._landmarks = {k: v for k, v in self._landmarks.items() if k in self._maps}
                self._landmarks[frame_id] = seen
                self._runner.submit(problem)
                return

    def _is_ready(self, frame_id: int, world: WorldMap) -> bool:
        later = [k for k in self._kept if k > frame_id]
        keyframe = world.keyframe(frame_id)
        if len(later) >= _MAX_LATER or keyframe is None:
            return True
        sought = depth_range(landmark_depths(world, keyframe)[1])
        if sought is None:
            return False
        posed = self._posed(keyframe, sorted(later), world)
        return len(choose_neighbours(keyframe.T_world_cam, sought.median, posed)) >= NUM_NEIGHBOURS

    def _problem(self, keyframe: Keyframe, sought: DepthRange | None, world: WorldMap) -> DepthProblem | None:
        """What is asked about a keyframe; None where there is too little to tell its depth from."""
        if sought is None:
            return None
        frame_id = keyframe.frame_id
        before = sorted((k for k in self._kept if k < frame_id), reverse=True)
        after = sorted(k for k in self._kept if k > frame_id)
        sides = [self._posed(keyframe, side, world) for side in (before, after)]
        return depth_problem(self._kept[frame_id].to_compare(), keyframe.T_world_cam, sought, sides)

    def _posed(
        self, keyframe: Keyframe, frame_ids: Sequence[int], world: WorldMap
    ) -> Iterator[tuple[View, Array]]:
        """Yield views with their poses, of those keyframes that are in the same part as one."""
        for k in frame_ids:
            T_world_nbr = world.pose_of_frame(k)
            if world.submap_of.get(k) == keyframe.submap and T_world_nbr is not None:
                yield self._kept[k].to_compare(), T_world_nbr

    def _confirm(self, frame_id: int, world: WorldMap) -> None:
        """Make points of what other keyframes see too, and those before have not added yet."""
        keyframe, view = world.keyframe(frame_id), self._kept.get(frame_id)
        if keyframe is None or view is None or world.pose_of_frame(frame_id) is None:
            return
        found = self._maps[frame_id]
        others = [self._maps[k] for k in confirming(self._maps, frame_id)]
        confirmed = confirmed_by(found, view.K, self._seen_from(keyframe, others, world))
        covering = self._seen_from(keyframe, list(self._confirmed.values()), world)
        points, pixels = added_points(confirmed, view.K, covering)
        self._confirmed[frame_id] = confirmed
        for old in sorted(self._confirmed)[:-NUM_COVERING]:
            del self._confirmed[old]
        patch = DensePatch(frame_id, points, view.rgb[pixels], view.confidence[pixels])
        if len(patch.xyz):
            self._cloud.add(patch, *landmark_depths(world, keyframe))

    def _seen_from(self, keyframe: Keyframe, maps: Sequence[DepthMap], world: WorldMap) -> list[OtherDepth]:
        """Other keyframes' depth as ``consistency`` takes it, of those that are of the same part."""
        others = []
        for found in maps:
            T_world_other, view = world.pose_of_frame(found.frame_id), self._kept.get(found.frame_id)
            same_part = world.submap_of.get(found.frame_id) == keyframe.submap
            if T_world_other is not None and view is not None and same_part:
                T_other_ref = invert_transform(T_world_other) @ keyframe.T_world_cam
                others.append(OtherDepth(found.inverse_depth, found.step, view.K, T_other_ref))
        return others
