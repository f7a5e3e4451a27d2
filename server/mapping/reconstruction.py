"""The reconstruction: frames in, poses and a map out. One object per stream, used from one thread."""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.mapping.beginning import Beginning
from semcast.server.mapping.blank import result_of_nothing, shows_nothing
from semcast.server.mapping.bundle_problem import BundleRunner
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.keyframe_rule import wants_keyframe
from semcast.server.mapping.locator import RECOGNISED_CONFIDENCE, Locator
from semcast.server.mapping.map_arrays import RunState
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.map_update import update_of
from semcast.server.mapping.outage import Outage
from semcast.server.mapping.readout import Readout
from semcast.server.mapping.rolling_shutter import ImageFlow, RollingShutter
from semcast.server.mapping.scale_watch import ScaleWatch
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.start_geometry import MIN_POINTS, Start
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate, TrackingState
from semcast.server.mapping.submap_placement import SubmapPlacement
from semcast.server.mapping.tracker import TrackedPose
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import WorldMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes between two attempts to recognise an older submap.
_JOIN_INTERVAL = 3
#: Share of the landmarks in sight that must agree with a pose found without a prior.
_MIN_SHARE_WHEN_LOST = 0.5


class Reconstruction:
    """Tracks the camera and maps what it sees.

    Args:
        camera: Of the decoded images, without distortion.
        settings: How.
        bundle: Runs the adjustments; closed with the reconstruction.

    Raises:
        ValueError: The camera has distortion.
    """

    def __init__(self, camera: Intrinsics, settings: ReconstructionSettings, bundle: BundleRunner) -> None:
        if camera.is_distorted:
            raise ValueError(f"camera must be without distortion, got {camera.distortion}")
        self._camera = camera
        self._settings = settings
        self._bundle = bundle
        self._map = MapBuilder(camera, settings, bundle, self._moved)
        self._map_epoch = 0
        self._begin(settings.with_readout(camera))

    def _begin(self, camera: Intrinsics) -> None:
        s = self._settings
        self._tracks = TrackTable(s.confidence, s.max_features, s.seed, turntable=s.turntable)
        self._motion = CameraMotion(self._camera)
        self._locator = Locator(self._camera, s, self._map, self._tracks, self._motion)
        self._placement = SubmapPlacement(self._camera, self._map.enough)
        self._beginning = Beginning(self._camera, s, self._map, self._tracks, self._motion, self._placement)
        self._scale = ScaleWatch(self._camera)
        self._shutter = RollingShutter(camera, lambda: self._map.watch.is_on)
        self._outage = Outage()
        self._state = TrackingState.INITIALIZING
        self._last_frame_id = -1
        self._last_posed_id: int | None = None
        self._lost_ns: list[int] = []
        self._frames_since_keyframe = self._keyframes_since_join = 0
        self._stage_ms: dict[str, float] = {}
        self._on_pose: Callable[[FrameResult], None] | None = None

    def reset(self) -> None:
        """Forget the map; the next one has another epoch."""
        self._map_epoch += 1
        self._map.clear()
        self._begin(self.camera)

    @property
    def camera(self) -> Intrinsics:
        """Pinhole, with the readout that images are put right for: given, or found."""
        return self._shutter.camera

    @property
    def flows(self) -> Mapping[int, ImageFlow]:
        """How the newest images moved, by frame id, as far as known: by that they are put right."""
        return self._shutter.flows

    def close(self) -> None:
        """End the bundle runner. Idempotent."""
        self._bundle.close()

    def process(
        self, frame: DecodedFrame, on_pose: Callable[[FrameResult], None] | None = None
    ) -> FrameResult:
        """Track one frame and extend the map with it.

        No image content makes it fail. A frame not newer than the last one is not tracked: its result has the
        pose it got before, if any.

        Args:
            frame: The frame.
            on_pose: Is told the result of a frame that is located, and of no other, before the map is
                extended with it. What is returned has the pose after that, and what it corrected.

        Raises:
            ValueError: An array has another shape than the camera's image, or another number type.
        """
        frame.check(self._camera.shape_hw)
        self._on_pose = on_pose
        try:
            return self._process(frame)
        finally:
            self._stage_ms = {}

    def _process(self, frame: DecodedFrame) -> FrameResult:
        if frame.frame_id <= self._last_frame_id:
            return self._result(frame, self._map.world.pose_of_frame(frame.frame_id), None)
        self._last_frame_id = frame.frame_id
        if shows_nothing(frame.image):
            # As a frame that never came: tracks outlive a covered lens as they outlive a gap.
            return result_of_nothing(frame, self._state, self._map_epoch, self._map.submap)
        self.collect()
        is_tracked = self._state is TrackingState.TRACKING
        if self._outage.takes(frame):
            located = self._locate_only(frame) if is_tracked else None
            return located or result_of_nothing(frame, self._state, self._map_epoch, self._map.submap)
        since = time.perf_counter_ns()
        sight = self._shutter.see(frame)
        T_world_guess = self._motion.predict(frame.t_source_ns)
        self._locator.follow(sight, T_world_guess if is_tracked else None)
        sight, is_first = self._shutter.settle(frame, sight, self._tracks)
        if is_first:
            self._beginning.clear()
        self._lap("track", since)
        result = self._track(sight, T_world_guess) if is_tracked else self._find(sight)
        self._placement.note(sight, result.T_world_cam, self._motion, self._map.world)
        self._shutter.keep_up()
        return result

    def _lap(self, stage: str, since_ns: int) -> None:
        self._stage_ms[stage] = self._stage_ms.get(stage, 0.0) + (time.perf_counter_ns() - since_ns) * 1e-6

    def collect(self) -> None:
        """Apply a finished adjustment now, not when the next frame comes, which then has its pose sooner."""
        since = time.perf_counter_ns()
        result = self._map.collect()
        if result is None:
            return
        self._stage_ms["bundle"] = result.elapsed_ms
        if (more := self._map.watch.take_found()) is not None:
            self._map.put_right(self._shutter.add(more), self._shutter.flows)
        self._moved(1.0)
        self._lap("apply", since)

    def _moved(self, scale: float) -> None:
        """The map was moved: so is the last pose."""
        if (T_world_last := self._last_pose()) is not None:
            self._motion.correct(T_world_last, scale)

    def _moves_to(self, frame_id: int, t_source_ns: int, T_world_cam: Array, ids: Ids) -> None:
        """Let the motion go on; frames that now turn out to have shown an older image have no pose."""
        xyz, stands = self._map.world.landmarks.xyz_of(ids), self._tracks.passing.camera_stands
        self._map.watch.note(frame_id, t_source_ns)
        older = self._motion.observe(frame_id, t_source_ns, T_world_cam, xyz, stands=stands)
        self._map.world.forget_frames(older)

    def _last_pose(self) -> Array | None:
        return None if self._last_posed_id is None else self._map.world.pose_of_frame(self._last_posed_id)

    def _track(self, sight: Sight, T_world_guess: Array | None) -> FrameResult:
        since = time.perf_counter_ns()
        pose = self._locator.track(sight, T_world_guess)
        self._lap("pose", since)
        if pose is not None:
            return self._accept(sight, pose)
        logger.debug("frame %d: tracking is lost", sight.frame.frame_id)
        self._state, self._lost_ns = TrackingState.LOST, []
        self._beginning.clear()
        return self._find(sight)

    def _accept(self, sight: Sight, pose: TrackedPose) -> FrameResult:
        """Take a pose: note it, weed out tracks that slipped, and make a keyframe where one is due."""
        frame, tracks = sight.frame, self._tracks
        self._state, self._lost_ns = TrackingState.TRACKING, []
        self._note_pose(frame, pose)
        tracks.keep(~np.isin(tracks.ids, pose.ids[~pose.inliers], assume_unique=True))
        tracks.vouch(pose.ids[pose.inliers])
        cues = self._map.keyframe_cues(tracks, sight, pose.num_inliers, self._frames_since_keyframe)
        is_keyframe = wants_keyframe(cues)
        if self._on_pose is not None:
            self._on_pose(self._result(frame, pose.T_world_cam, pose, is_keyframe=is_keyframe))
        # The pose is on its way now, and nobody waits.
        self._moves_to(frame.frame_id, frame.t_source_ns, pose.T_world_cam, pose.ids[pose.inliers])
        self._map.world.note_sight(pose.ids, pose.inliers, frame.frame_id)
        if is_keyframe:
            since = time.perf_counter_ns()
            pose = self._improved(sight, pose)
            tracks.refill(sight)
            self._map.make_keyframe(sight, tracks, pose.T_world_cam)
            pose = self._put_straight(frame) or pose
            self._scale.look(self._map.world, self._map.noise.model)
            self._frames_since_keyframe = 0
            self._lap("map", since)
            pose = pose.with_unit(self._try_to_join(sight))
            pose = pose.with_unit(self._map.place_again(self._placement))
        return self._result(frame, self._last_pose(), pose, is_keyframe=is_keyframe)

    def _put_straight(self, frame: DecodedFrame) -> TrackedPose | None:
        """Build the newest keyframes anew where the map went wrong; the frame's pose then, if it is sure."""
        moved = self._map.put_straight(frame.image)
        if not moved:
            return None
        logger.info("frame %d: the map went wrong since frame %d", frame.frame_id, moved[0].frame_id)
        self._motion.begin_with(moved, self._map.world)
        return self._locator.pose(moved[-1].T_world_cam)

    def _improved(self, sight: Sight, pose: TrackedPose) -> TrackedPose:
        """Take drift out of a keyframe to be: out of its tracks, and where the camera has been before."""
        if self._map.anchor(self._tracks, sight, pose.T_world_cam):
            pose = self._posed_anew(sight, pose.T_world_cam) or pose
        if self._map.revisit(self._tracks, sight, pose.T_world_cam):
            T_world_guess = self._map.world.pose_of_frame(sight.frame.frame_id)
            assert T_world_guess is not None
            pose = self._posed_anew(sight, T_world_guess) or replace(pose, T_world_cam=T_world_guess)
        return pose

    def _posed_anew(self, sight: Sight, T_world_guess: Array) -> TrackedPose | None:
        """Estimate the pose of a frame again whose tracks or landmarks have moved."""
        anew = self._locator.pose(T_world_guess)
        if anew is not None:
            self._note_pose(sight.frame, anew)
            self._moved(1.0)
        return anew

    def _locate_only(self, frame: DecodedFrame) -> FrameResult | None:
        """Pose of a frame by tracks that stay as the frames before left them; None where it is not sure.

        Only a camera that sees something else by now goes on from such a frame: what it knows would be gone.
        """
        since = time.perf_counter_ns()
        sight, T_world_guess = self._shutter.see(frame), self._motion.predict(frame.t_source_ns)
        before = self._tracks.as_they_are()
        self._locator.follow(sight, T_world_guess)
        pose = self._locator.track(sight, T_world_guess)
        self._lap("track", since)
        if pose is None:
            self._tracks.put_back(before)
            return None
        self._note_pose(frame, pose)
        cues = self._map.keyframe_cues(self._tracks, sight, pose.num_inliers, self._frames_since_keyframe)
        if wants_keyframe(cues, is_in_outage=True):
            result = self._accept(sight, pose)
        else:
            result = self._result(frame, pose.T_world_cam, pose)
            if self._on_pose is not None:
                self._on_pose(result)
            self._moves_to(frame.frame_id, frame.t_source_ns, pose.T_world_cam, pose.ids[pose.inliers])
            self._tracks.put_back(before)
        self._placement.note(sight, pose.T_world_cam, self._motion, self._map.world)
        return result

    def _note_pose(self, frame: DecodedFrame, pose: TrackedPose) -> None:
        reference = self._map.reference_keyframe()
        assert reference is not None
        self._frames_since_keyframe += frame.frame_id != self._last_posed_id
        self._last_posed_id = frame.frame_id
        self._map.world.add_frame(frame.frame_id, reference.frame_id, pose.T_world_cam)

    def _find(self, sight: Sight) -> FrameResult:
        """A frame without a running track: recognise a place, or work towards a new map."""
        if (found := self._recover(sight)) is not None:
            return self._accept(sight, found)
        if self._state is TrackingState.LOST:
            self._give_up_in_time(sight.frame)
        start = self._look_for_start(sight)
        return self._result(sight.frame, None, None) if start is None else self._begin_map(sight, start)

    def _give_up_in_time(self, frame: DecodedFrame) -> None:
        """Begin a new submap where the map has not been in sight for long."""
        # An empty image is no sign of another place: only frames that a map could begin with count.
        self._lost_ns += [frame.t_source_ns] if len(self._tracks) >= MIN_POINTS else []
        if self._settings.gives_up(self._lost_ns, rested=self._motion.rests):
            logger.info("frame %d: a new map is begun, the old one is not in sight", frame.frame_id)
            self._state = TrackingState.INITIALIZING
            self._map.world.forget_frames(self._motion.give_up())
            self._beginning.begin_submap()

    def _look_for_start(self, sight: Sight) -> Start | None:
        since = time.perf_counter_ns()
        start = self._beginning.look(sight, is_lost=self._state is TrackingState.LOST)
        self._lap("two_view", since)
        return start

    def _recover(self, sight: Sight) -> TrackedPose | None:
        """Pose of a frame after tracking was lost: by tracks that are still alive, else by recognition."""
        if not self._map.world.keyframes:
            return None
        since = time.perf_counter_ns()
        is_lost = self._state is TrackingState.LOST
        pose = self._locator.pose(None, min_share=_MIN_SHARE_WHEN_LOST) if is_lost else None
        if pose is None:
            T_world_rest = self._last_pose() if is_lost and self._motion.rests else None
            pose = None if T_world_rest is None else self._locator.unhidden(sight, T_world_rest)
            pose = pose or self._recognise(sight)
        self._lap("relocalise", since)
        return pose

    def _recognise(self, sight: Sight) -> TrackedPose | None:
        whereabouts = self._locator.whereabouts
        T_world_guess = None if whereabouts is None else self._motion.predict(sight.frame.t_source_ns)
        if (place := self._map.recognise(sight, T_world_guess, whereabouts)) is None:
            return None
        # Nothing is given up for a place before there is a pose in it.
        if (pose := self._locator.pose_at(place)) is not None:
            last = self._map.world.submap_of_frame(self._last_posed_id)
            if last is not None and place.submap < last == self._map.world.keyframes[-1].submap:
                self._settle(last, sight, pose.T_world_cam, place.submap)
            if whereabouts is None or place.submap != last:
                self._motion.reset()
            self._map.go_on_from(place)
            self._tracks.adopt(place.ids, place.xy, RECOGNISED_CONFIDENCE)
            self._beginning.clear()
        return pose

    def _settle(self, submap: int, sight: Sight, T_world_cam: Array, older: int) -> None:
        """Put the newest submap where it is, now that the camera is back from it in an older one."""
        self._map.finish()
        found = self._placement.come_back(sight, T_world_cam, older, self._motion, self._map.world)
        if found is not None:
            logger.info(
                "frame %d: back in an older part, the newest one is put between", sight.frame.frame_id
            )
            self._map.move_guessed(submap, *found)

    def _begin_map(self, sight: Sight, start: Start) -> FrameResult:
        """Bring a start into the map and pose the frames that waited for it."""
        since = time.perf_counter_ns()
        ids, backfilled = self._beginning.bring_in(sight, start)
        for posed in backfilled:
            self._moves_to(*posed, ids)
        backfilled = tuple(posed for posed in backfilled if posed[0] in self._map.world.frames)
        self._frames_since_keyframe = 0
        self._lap("two_view", since)
        newest, seen = self._map.world.pose_of_frame(sight.frame.frame_id), self._tracks.seen()
        pose = self._locator.pose(newest, seen[self._map.world.landmarks.rows(seen.ids) >= 0])
        self._state, self._lost_ns = TrackingState.LOST if pose is None else TrackingState.TRACKING, []
        self._last_posed_id = sight.frame.frame_id
        if pose is not None:
            self._moves_to(sight.frame.frame_id, sight.frame.t_source_ns, pose.T_world_cam, ids)
        return self._result(sight.frame, newest, pose, is_keyframe=True, backfilled=backfilled)

    def _try_to_join(self, sight: Sight) -> float:
        """Look from time to time whether an older submap is in sight again; the factor on lengths, else 1."""
        self._keyframes_since_join += 1
        if not self._map.other_submaps() or self._keyframes_since_join < _JOIN_INTERVAL:
            return 1.0
        since = time.perf_counter_ns()
        self._keyframes_since_join = 0
        # Not by the pose it was tracked at: the map may have been built anew since.
        place, T_world_cam = self._map.recognise_other_submap(sight), self._last_pose()
        scale = None
        if place is not None and T_world_cam is not None:
            scale = self._map.join(place, T_world_cam, self._tracks)
        if scale is not None:
            logger.info("frame %d: submaps are joined", sight.frame.frame_id)
        self._lap("relocalise", since)
        return 1.0 if scale is None else scale

    def _result(
        self,
        frame: DecodedFrame,
        T_world_cam: Array | None,
        pose: TrackedPose | None,
        *,
        is_keyframe: bool = False,
        backfilled: tuple[tuple[int, int, Array], ...] = (),
    ) -> FrameResult:
        visible = self._tracks.visible
        ids = self._tracks.ids[visible]
        agrees = np.isin(ids, [] if pose is None else pose.ids[pose.inliers], assume_unique=True)
        covariance = None
        if pose is not None and T_world_cam is not None and frame.frame_id in self._map.world.frames:
            # Not of where ``pose`` has it: a join may have moved the map since.
            covariance = self._map.pose_covariance(pose.covariance, T_world_cam)
        return FrameResult(
            frame_id=frame.frame_id,
            t_source_ns=frame.t_source_ns,
            state=self._state,
            T_world_cam=T_world_cam,
            num_tracked=len(ids),
            num_inliers=0 if pose is None else pose.num_inliers,
            reprojection_error_px=None if pose is None else pose.median_error_px,
            covariance=covariance,
            is_keyframe=is_keyframe,
            map_epoch=self._map_epoch,
            submap=self._map.submap,
            keypoints_xy=self._shutter.in_image(self._tracks.xy[visible]).astype(np.float32),
            keypoint_inlier=agrees,
            backfilled=backfilled,
            stage_ms=dict(self._stage_ms),
        )

    def put_right(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image of the newest frame as its tracks have it: of a rolling shutter, put right."""
        return self._shutter.put_right(image)

    def take_map_update(self) -> MapUpdate | None:
        """What changed in the map since this was last called, None when nothing did."""
        world = self._map.world
        changes = world.take_changes()
        return update_of(world, changes, self._map_epoch) if any(map(len, changes)) else None

    def whole_map(self) -> MapUpdate:
        """The map as one update, whatever was taken before."""
        return update_of(self._map.world, self._map.world.everything(), self._map_epoch)

    def conclude(self) -> int:
        """Adjust the whole map of a stream that has ended, if settings want it; the number of keyframes."""
        return self._map.adjust_whole()

    def final_trajectory(self) -> dict[int, Array]:
        """Best current ``T_world_cam`` of all posed frames, by frame id; waits for a running adjustment."""
        self._map.finish()
        return self._map.world.trajectory()

    def landmarks(self) -> tuple[Ids, Array, NDArray[np.uint8], NDArray[np.float32]]:
        """All landmarks: ids ``(N,)``, world ``xyz (N, 3)``, ``rgb (N, 3)``, confidence ``(N,)``."""
        return self._map.world.landmarks.points()

    @property
    def world(self) -> WorldMap:
        """The map itself, to be looked at between two frames and not to be changed."""
        return self._map.world

    def snapshot(self) -> dict[str, NDArray]:
        """The map and what is needed to go on with it, as plain arrays."""
        counters = [self._map_epoch, self._map.submap, self._tracks.next_id, self._last_frame_id]
        state = RunState(counters, self._map.noise.state(), Readout.of(self.camera))
        return {**self._map.world.arrays(), **state.arrays()}

    def restore(self, arrays: Mapping[str, NDArray]) -> None:
        """Go on with the map of a snapshot: the next frame is located in it as after a loss of tracking.

        Raises:
            KeyError: An array is missing.
            ValueError: Arrays contradict each other.
        """
        state = RunState.of(arrays)
        self._map.clear()
        found = state.readout if self._map.watch.is_on else None
        self._begin(self.camera if found is None else found.put_on(self.camera))
        self._map.world.restore(dict(arrays))
        self._map.noise.restore(state.noise)
        self._map_epoch, self._map.submap, self._tracks.next_id, self._last_frame_id = state.counters
        if self._map.world.keyframes:
            self._state = TrackingState.LOST
