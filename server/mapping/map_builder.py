"""The map as it grows: keyframes, their landmarks, adjustments, and submaps that are joined."""

import logging
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.weighting import GATE_SIGMAS, OnlineNoise
from semcast.server.geometry.whereabouts import Whereabouts
from semcast.server.mapping.adjuster import Adjuster
from semcast.server.mapping.anchoring import anchor_tracks, resembles
from semcast.server.mapping.bridging import Bridge
from semcast.server.mapping.bundle_problem import BundleResult, BundleRunner
from semcast.server.mapping.contradiction import Contradiction
from semcast.server.mapping.guessed_place import GuessedPlace
from semcast.server.mapping.joining import may_join
from semcast.server.mapping.kept_frames import Observed, colours_of
from semcast.server.mapping.keyframe_images import ImagedMap, KeyframeImages, SeenFrom
from semcast.server.mapping.keyframe_rule import KeyframeCues, median_flow_px
from semcast.server.mapping.late_readout import put_map_right
from semcast.server.mapping.loop_closure import Loop, LoopFinder, LoopView, share_out
from semcast.server.mapping.new_landmarks import add_landmarks
from semcast.server.mapping.pose_covariance import pose_covariance
from semcast.server.mapping.readout_watch import ReadoutWatch
from semcast.server.mapping.rebuilding import put_straight
from semcast.server.mapping.recall import recall_landmarks
from semcast.server.mapping.recognition import Recogniser
from semcast.server.mapping.relocalisation import Place, Relocaliser, submap_similarity
from semcast.server.mapping.revisit import Revisit, find_revisit, old_sigma_px, place_anew
from semcast.server.mapping.rolling_shutter import ImageFlow
from semcast.server.mapping.scene_depth import usual_depth
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.submap_placement import SubmapPlacement
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.wide_recognition import WideRecogniser
from semcast.server.mapping.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes whose images are kept: 45 MB of 640x480.
_MAX_IMAGES = 150
#: A keyframe has enough landmarks with this share of ``max_features``.
_ENOUGH_SHARE = 0.2
#: Landmarks seen again may raise the number of tracks to this many times ``max_features``.
_MAX_TRACKS_SHARE = 1.2
#: The newest keyframes, which stay where older ones are thinned out: an adjustment's window is among them.
_MAX_RECENT = 40


class MapBuilder:
    """Owns the map and everything that changes it.

    Args:
        camera: Pinhole.
        settings: Of the reconstruction.
        bundle: Runs the adjustments.
        on_moved: Called after the map has moved under the camera, with the factor on lengths around it.
    """

    def __init__(
        self,
        camera: Intrinsics,
        settings: ReconstructionSettings,
        bundle: BundleRunner,
        on_moved: Callable[[float], None],
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._adjuster = Adjuster(camera, settings, bundle)
        self._on_moved = on_moved
        self.clear()

    def clear(self) -> None:
        """Forget the map; an adjustment under way is not applied any more."""
        s = self._settings
        self._adjuster.begin()
        self.world = WorldMap()
        self.relocaliser = Relocaliser(self._camera, s.seed, s.max_features)
        self._recogniser = Recogniser(self.relocaliser, WideRecogniser(self._camera, s.seed))
        self.enter(0)
        self.num_inliers_at_keyframe = 0
        self.images = KeyframeImages(_MAX_IMAGES)

    @property
    def noise(self) -> OnlineNoise:
        """Of observations."""
        return self._adjuster.noise

    @property
    def watch(self) -> ReadoutWatch:
        """Whether adjustments tell of a rolling shutter, or of another lens."""
        return self._adjuster.watch

    @property
    def _mapped(self) -> ImagedMap:
        return ImagedMap(self._camera, self.world, self.images, self.submap)

    def reference_keyframe(self) -> Keyframe | None:
        """Newest keyframe of the current submap."""
        return next((k for k in reversed(self.world.keyframes) if k.submap == self.submap), None)

    def other_submaps(self) -> set[int]:
        """Submaps that have keyframes, without the current one."""
        return {k.submap for k in self.world.keyframes} - {self.submap}

    def begin_submap(self) -> None:
        """Begin a new submap, which the next start will fill."""
        self.enter(1 + max(self.world.submap_of.values(), default=-1))

    def enter(self, submap: int) -> None:
        """Make a submap the current one."""
        self._recognised: int | None = None
        self.loops = LoopFinder(self._camera, self.relocaliser, self._settings.seed)
        self._contradiction = Contradiction(self._camera, self._settings.seed)
        self.submap = submap

    def go_on_from(self, place: Place) -> None:
        """Go on in the submap of a place that was recognised; the next keyframe is tied to the one there."""
        self.enter(place.submap)
        self._recognised = place.keyframe_id

    def take_start(
        self,
        start: Start,
        sight: Sight,
        tracks: TrackTable,
        place: Bridge,
        history: Sequence[Observed],
    ) -> None:
        """Bring a new map in and adjust it at once.

        Args:
            start: The new map, first keyframe at the origin.
            sight: The newest image.
            tracks: Tracks in it; put where the start has them.
            place: Pose of the first keyframe in the world, and world units per unit of the start: a guess,
                unless the map is empty.
            history: The frames it was made from, with colours, and with the images of keyframes.
        """
        placed, scale = place.T_world_cam, place.scale
        if self.world.keyframes:
            first_id = start.keyframes[0].frame_id
            self.world.guesses[self.submap] = GuessedPlace(first_id, place.covariance)
        for keyframe in start.keyframes:
            T = keyframe.T_world_cam.copy()
            T[:3, 3] *= scale
            keyframe.T_world_cam = placed @ T
            keyframe.submap = self.submap
            self.world.add_keyframe(keyframe)
        for observed in history:
            if observed.grey is not None and any(k.frame_id == observed.frame_id for k in start.keyframes):
                self.images.append(SeenFrom(observed.frame_id, observed.grey))
        newest = start.keyframes[-1]
        row, row_k = shared_rows(tracks.ids, newest.ids)
        tracks.settle_at(row, newest.xy[row_k], np.full(len(row), np.nan))
        newest.descriptor_ids, newest.descriptors = self.relocaliser.describe(
            sight.grey, newest.ids, newest.xy
        )
        xyz = transform_points(placed, scale * start.xyz)
        born = np.full(len(start.ids), newest.frame_id)
        for keyframe in start.keyframes:
            born[np.isin(start.ids, keyframe.ids, assume_unique=True)] = keyframe.frame_id
        rgb = colours_of(start.ids, history)
        self.world.add_landmarks(start.ids, xyz, rgb, start.confidence, self.submap, born)
        self._adjuster.submit(self.world, self.submap, start=True)
        self.collect(wait=True)
        self._add_landmarks(sight.frame.image)
        self._bound()
        self._adjuster.submit(self.world, self.submap, start=True)
        self.collect(wait=True)
        self._count_inliers(tracks.ids[tracks.visible])

    def anchor(self, tracks: TrackTable, sight: Sight, T_world_cam: Array) -> int:
        """Align tracks with how earlier keyframes of this submap saw them; the number aligned."""
        return anchor_tracks(self._mapped, tracks, sight, T_world_cam)

    def depth(self) -> float:
        """How far away the scene is, map units."""
        return usual_depth(self.world, self.enough)

    def recognise(
        self, sight: Sight, T_world_guess: Array | None, whereabouts: Whereabouts | None
    ) -> Place | None:
        """Look for the place of an image whose camera is lost.

        Args:
            sight: The image.
            T_world_guess: Where its motion leads the camera, None where that is not known.
            whereabouts: Where it can be in the submap of the newest keyframe, None for anywhere.
        """
        return self._recogniser.find(sight, self._mapped, self.noise.model, T_world_guess, whereabouts)

    def resembles(self, tracks: TrackTable, sight: Sight, T_world_cam: Array, ids: Ids) -> bool:
        """Tell whether tracks that agree with a pose show what the newest keyframes saw."""
        return resembles(self._mapped, tracks, sight, T_world_cam, ids)

    def recall(
        self, tracks: TrackTable, sight: Sight, T_world_cam: Array, *, wanted: int, reach_px: float
    ) -> Ids:
        """Give lost landmarks of the newest keyframes their tracks back; ids of those found."""
        return recall_landmarks(self._mapped, tracks, sight, T_world_cam, reach_px=reach_px, wanted=wanted)

    def revisit(self, tracks: TrackTable, sight: Sight, T_world_cam: Array) -> bool:
        """Use what was seen long ago and is in sight again: close a loop, take up landmarks.

        Args:
            tracks: Of a frame that becomes a keyframe; found landmarks get their tracks back.
            sight: Its image.
            T_world_cam: Its pose.

        Returns:
            Whether the map or the tracks have changed.
        """
        found = self._find_revisit(tracks, sight, T_world_cam)
        seen = tracks.visible
        view = LoopView(sight, T_world_cam, tracks.ids[seen], tracks.xy[seen])
        loop = self.loops.look(view, self.world, self.noise.model, self.submap, found)
        closed = loop is not None and self._close(loop)
        if closed:
            T_now = self.world.pose_of_frame(sight.frame.frame_id)
            T_world_cam = T_world_cam if T_now is None else T_now
            found = self._find_revisit(tracks, sight, T_world_cam)
        elif self.loops.is_in_doubt:
            return False
        return (found is not None and self._take_up(found, tracks, sight, T_world_cam) > 0) or closed

    def _find_revisit(self, tracks: TrackTable, sight: Sight, T_world_cam: Array) -> Revisit | None:
        gate_px = GATE_SIGMAS * old_sigma_px(self.noise.model)
        return find_revisit(self._mapped, tracks.ids, sight, T_world_cam, gate_px=gate_px)

    def _close(self, loop: Loop) -> bool:
        """Share out what drifted since the camera was at the loop's place; whether that was possible."""
        found = share_out(self.world, self.submap, loop)
        if found is None:
            self.loops.refuse()
            return False
        keyframe_ids, solved = found
        self._adjuster.abandon()
        self.world.bend(keyframe_ids, solved.T_world_cam, solved.scale)
        self.world.revisits[loop.keyframe_id] = loop.place.keyframe_id
        ends = loop.place.keyframe_id, loop.keyframe_id
        self.world.drift.close(*ends, keyframe_ids.tolist(), self.world.poses)
        self._on_moved(float(solved.scale[-1]))
        logger.info("keyframe %d: a loop is closed, to keyframe %d", loop.keyframe_id, loop.place.keyframe_id)
        return True

    def _take_up(self, found: Revisit, tracks: TrackTable, sight: Sight, T_world_cam: Array) -> int:
        """Give landmarks of long ago their tracks back; how many."""
        world, noise = self.world, self.noise.model
        points = place_anew(self._camera, world, found, T_world_cam, noise, old_sigma_px(noise))
        room = int(_MAX_TRACKS_SHARE * self._settings.max_features) - int(tracks.visible.sum())
        points = points.strongest(max(0, room))
        # Where an old landmark and a young track are in one place, the young one gives way.
        tracks.keep(~tracks.beside(points.xy[points.ok]))
        ids = tracks.bring_back(sight, found.ids, points)
        if len(ids) == 0:
            return 0
        frame_id = sight.frame.frame_id
        logger.debug("frame %d: %d landmarks of keyframe %d again", frame_id, len(ids), found.keyframe_id)
        world.note_sight(ids, np.ones(len(ids), bool), frame_id)
        world.revisits[frame_id] = found.keyframe_id
        self.loops.note_tie(found.keyframe_id)
        return len(ids)

    def keyframe_cues(
        self, tracks: TrackTable, sight: Sight, num_inliers: int, frames_since: int
    ) -> KeyframeCues:
        """Return what tells whether a frame should become a keyframe.

        Args:
            tracks: Of the frame.
            sight: Its image.
            num_inliers: Landmarks its pose rests on.
            frames_since: Frames since the newest keyframe.
        """
        ids, xy = tracks.ids[tracks.visible], tracks.xy[tracks.visible]
        reference = self.reference_keyframe()
        assert reference is not None
        return KeyframeCues(
            num_inliers=num_inliers,
            num_inliers_at_keyframe=self.num_inliers_at_keyframe,
            num_visible=len(ids),
            max_features=self._settings.max_features,
            median_flow_px=median_flow_px(reference, ids, xy),
            width_px=self._camera.width,
            frames_since=frames_since,
            usable_share=float(sight.usable.mean()),
        )

    def make_keyframe(self, sight: Sight, tracks: TrackTable, T_world_cam: Array) -> None:
        """Turn the newest frame into a keyframe, triangulate, and ask for an adjustment."""
        frame, world = sight.frame, self.world
        visible = tracks.visible & ~tracks.suspect
        ids, xy = tracks.ids[visible], tracks.xy[visible]
        self.images.append(SeenFrom(frame.frame_id, sight.grey))
        descriptor_ids, descriptors = self.relocaliser.describe(sight.grey, ids, xy)
        self._tie_to_recognised(frame.frame_id)
        world.add_keyframe(
            Keyframe(
                frame_id=frame.frame_id,
                t_source_ns=frame.t_source_ns,
                T_world_cam=T_world_cam,
                submap=self.submap,
                ids=ids,
                xy=xy,
                confidence=tracks.confidence[visible],
                edge=tracks.edge[visible],
                descriptor_ids=descriptor_ids,
                descriptors=descriptors,
            )
        )
        self._add_landmarks(frame.image)
        self._count_inliers(ids)
        self._bound()
        self._adjuster.submit(self.world, self.submap)

    def _tie_to_recognised(self, frame_id: int) -> None:
        """Tie a keyframe to the one the camera was found back at, where no adjustment would take that one in.

        The newest keyframes may share no landmark with this one: they would leave it, and those that follow,
        adrift until a loop is closed.
        """
        recognised, self._recognised = self._recognised, None
        window = self.world.keyframes_of(self.submap)[-self._settings.window_size :]
        if recognised is not None and recognised not in {k.frame_id for k in window}:
            self.world.revisits.setdefault(frame_id, recognised)

    @property
    def enough(self) -> int:
        """Number of landmarks with which a keyframe has enough."""
        return round(_ENOUGH_SHARE * self._settings.max_features)

    def _count_inliers(self, ids: NDArray[np.int64]) -> None:
        """Take how many of the tracks of the newest keyframe have a landmark."""
        self.num_inliers_at_keyframe = int((self.world.landmarks.rows(ids) >= 0).sum())

    def _add_landmarks(self, image: NDArray[np.uint8]) -> None:
        parallax_deg, noise = self._settings.min_parallax_deg, self.noise.model
        add_landmarks(self.world, self._camera, noise, image, parallax_deg, enough=self.enough)

    def _bound(self) -> None:
        """Keep the map, and the images of its keyframes, within its size."""
        s = self._settings
        if self.world.bound(s.max_landmarks, s.max_keyframes, recent=min(_MAX_RECENT, s.max_keyframes // 2)):
            self.images.keep({k.frame_id for k in self.world.keyframes})

    def collect(self, *, wait: bool = False) -> BundleResult | None:
        """Bring a finished adjustment into the map; the result, or None where there is none."""
        return self._adjuster.collect(self.world, wait=wait)

    def finish(self) -> None:
        """Wait for an adjustment under way."""
        if self.collect(wait=True) is not None:
            self._on_moved(1.0)

    def put_right(self, camera: Intrinsics, flows: Mapping[int, ImageFlow]) -> None:
        """Make up for a rolling shutter that was not known of, see ``put_map_right``, and adjust the map."""
        self._adjuster.abandon()
        put_map_right(self.world, self.images, camera, flows)
        self._adjuster.submit(self.world, self.submap, start=True)
        self.collect(wait=True)

    def put_straight(self, image: NDArray[np.uint8]) -> list[Keyframe]:
        """Build the newest keyframes anew where their tracks contradict the map; those that have moved."""
        noise = self.noise.model
        moved = put_straight(self._contradiction, self._mapped, noise, self._settings, settle=self.finish)
        if moved:
            self._add_landmarks(image)
            self._adjuster.submit(self.world, self.submap)
            self.collect(wait=True)
            self._count_inliers(moved[-1].ids)
        return moved

    def adjust_whole(self) -> int:
        """Adjust all keyframes with all they see, and say how many. Takes seconds where there are many."""
        self.finish()
        num_adjusted = self._adjuster.adjust_whole(self.world)
        if num_adjusted:
            self._on_moved(1.0)
        return num_adjusted

    def place_again(self, placement: SubmapPlacement) -> float:
        """Move the current submap to where it is by now known to begin; the factor on lengths, else 1."""
        found = placement.place_again(self.world, self.submap)
        return 1.0 if found is None else self.move_guessed(self.submap, *found)

    def move_guessed(self, submap: int, scale: float, T_new_old: Array, guess: GuessedPlace) -> float:
        """Move a submap by a similarity to where it is now guessed to be; returns the factor on lengths."""
        self._adjuster.abandon()
        self.world.transform_submap(submap, submap, scale, T_new_old)
        self.world.guesses[submap] = guess
        self._on_moved(scale)
        return scale

    def recognise_other_submap(self, sight: Sight) -> Place | None:
        """Look for the place of an image in the submaps other than the current one."""
        return self.relocaliser.find(sight, self.world, self.noise.model, self.other_submaps())

    def join(self, place: Place, T_world_cam: Array, tracks: TrackTable) -> float | None:
        """Join the current submap and the one a place was recognised in.

        The older of the two stays where it is, for its place in the world was not guessed.

        Args:
            place: The newest frame's place in the other submap.
            T_world_cam: Its pose in the current one.
            tracks: Its tracks.

        Returns:
            The scale of the similarity that moved the current submap, 1 if it stayed; None if none was found.
        """
        visible = tracks.visible
        found = submap_similarity(place, self.world, T_world_cam, tracks.ids[visible], tracks.xy[visible])
        if found is None:
            return None
        scale, T_place_mine = found
        T_mine_place = invert_transform(T_place_mine)
        T_mine_place[:3, 3] /= scale
        is_newer = self.submap > place.submap
        join = (scale, T_place_mine) if is_newer else (1.0 / scale, T_mine_place)
        older, newer = map(self.world.keyframes_of, sorted((self.submap, place.submap)))
        posed_ids = self.world.frames.keyframes()[0]
        depth = self.depth() * (scale if is_newer else 1.0)
        if not may_join(older, newer, *join, posed_ids=posed_ids, depth=depth):
            return None
        self._adjuster.abandon()
        moving, staying = (self.submap, place.submap) if is_newer else (place.submap, self.submap)
        moved_ids = [k.frame_id for k in self.world.keyframes_of(moving)]
        leader_id = place.keyframe_id if is_newer else self.world.keyframes_of(staying)[-1].frame_id
        self.world.transform_submap(moving, staying, *join)
        self.world.drift.follow(moved_ids, leader_id, self.world.poses)
        scale = scale if is_newer else 1.0
        self.enter(min(self.submap, place.submap))
        self.world.revisits[self.world.keyframes[-1].frame_id] = place.keyframe_id
        self._on_moved(scale)
        return scale

    def pose_covariance(self, covariance_in_map: Array | None, T_world_cam: Array) -> Array | None:
        """Covariance of a frame in the current submap, ``(6, 6)`` or None: see ``pose_covariance``."""
        return pose_covariance(self.world, self.submap, covariance_in_map, T_world_cam)
