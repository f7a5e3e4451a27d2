"""Where the camera of a frame is in the map: by its tracks, and by landmarks that are looked for again."""

import logging
from functools import partial

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.whereabouts import Whereabouts
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.relocalisation import Place
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Seen, Sight
from semcast.server.mapping.tracker import (
    MIN_BELIEVED_SHARE,
    MIN_INLIERS,
    TrackedPose,
    expected_positions,
    track_pose,
)
from semcast.server.mapping.tracks import TrackTable

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: Pyramid levels by which tracks are followed where no pose is expected: they may have gone far.
_START_LEVELS = 5
#: A pose that rests on fewer landmarks than this share of the tracks asks for more.
_FEW_INLIERS_SHARE = 0.2
#: How far from where they are expected lost landmarks are looked for, with a pose and with a prediction.
_REACH_PX, _REACH_BLIND_PX = 6.0, 20.0
#: Of a keypoint by which a place was recognised, until it is followed.
RECOGNISED_CONFIDENCE = 0.5
#: Landmarks a camera that was hidden is posed by: the first strip that comes into sight tells little.
_LEAST_UNHIDDEN = 30


class Locator:
    """Poses one frame after the other by what its tracks show of the map.

    Args:
        camera: Pinhole.
        settings: Of the reconstruction.
        builder: Owns the map.
        tracks: Followed into each frame.
        motion: Tells where the camera is expected.

    Attributes:
        whereabouts: Where the camera can be in the newest image if it comes after a gap, None for anywhere.
    """

    def __init__(
        self,
        camera: Intrinsics,
        settings: ReconstructionSettings,
        builder: MapBuilder,
        tracks: TrackTable,
        motion: CameraMotion,
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._map = builder
        self._tracks = tracks
        self._motion = motion
        self._is_after_gap = False
        self.whereabouts: Whereabouts | None = None
        self._has_gone_astray = False

    def follow(self, sight: Sight, T_world_guess: Array | None) -> None:
        """Follow the tracks into an image: to where a pose expects them, or on as they went so far."""
        tracks = self._tracks
        self._is_after_gap = self._motion.comes_after_gap(sight.frame.frame_id, sight.frame.t_source_ns)
        self.whereabouts = None
        if self._is_after_gap:
            self.whereabouts = self._motion.whereabouts(sight.frame.t_source_ns, self._map.depth())
        self._has_gone_astray = False
        if len(tracks) == 0:
            tracks.remember(sight)
        elif T_world_guess is not None:
            tracks.follow(sight, self._expected(T_world_guess, tracks))
        else:
            ahead = tracks.xy + tracks.velocity * (tracks.missed + 1)[:, None]
            tracks.follow(sight, ahead, max_level=_START_LEVELS)

    def _expected(self, T_world_cam: Array, tracks: TrackTable) -> Array:
        world = self._map.world
        T_world_seen = [world.pose_of_frame(frame_id) for frame_id in tracks.frame_ids]
        return expected_positions(self._camera, world, tracks, T_world_cam, T_world_seen)

    def pose(
        self,
        T_world_guess: Array | None,
        seen: Seen | None = None,
        *,
        min_share: float = MIN_BELIEVED_SHARE,
        may_carry: bool = False,
    ) -> TrackedPose | None:
        """Estimate the pose by the landmarks among what is seen, all tracks by default: ``track_pose``."""
        return track_pose(
            self._camera,
            self._map.world,
            self._map.noise.model,
            self._tracks.seen() if seen is None else seen,
            T_world_guess,
            submap=self._map.submap,
            seed=self._settings.seed,
            min_share=min_share,
            may_carry=may_carry,
            is_after_gap=self._is_after_gap,
        )

    def pose_at(self, place: Place) -> TrackedPose | None:
        """Pose of an image whose place was recognised, None where too few landmarks agree with any.

        From far off, landmarks are further from where the map has them than those of tracks ever are: what
        patches have proved stands, if no fewer agree within the error of patches.
        """
        seen = Seen(place.ids, place.xy, np.full(len(place.ids), RECOGNISED_CONFIDENCE))
        pose, proof = self.pose(place.T_world_cam, seen), place.proof
        if pose is None and proof is not None and proof.num_inliers >= MIN_INLIERS:
            return TrackedPose(
                place.T_world_cam, proof.covariance, place.ids, proof.inliers, proof.residual_px
            )
        return pose

    def track(self, sight: Sight, T_world_guess: Array | None) -> TrackedPose | None:
        """Pose of a frame whose tracks were followed; None where it is not sure, and they may be gone."""
        pose = self._possible(self.pose(T_world_guess, may_carry=True))
        if (
            pose is None
            and (T_world_on := self._motion.predict_on(sight.frame.t_source_ns)) is not None
            and self._tracks.follow_again(sight, partial(self._expected, T_world_on))
        ):
            pose = self.pose(T_world_on)
        if (
            pose is None
            and (T_world_step := self._motion.predict_step()) is not None
            and self._tracks.follow_again(sight, partial(self._expected, T_world_step))
        ):
            # Not where times say it can be: it is asked for where those may mislead.
            pose = self.pose(T_world_step)
        if pose is None and self._tracks.follow_jump(sight):
            pose = self._possible(self.pose(T_world_guess))
        if pose is None and self._has_gone_astray:
            self._tracks.clear()  # they are on another one of a row of equal things
        is_vague = pose is None or self._is_after_gap or pose.num_inliers < 2 * MIN_INLIERS
        pose = self._with_more(sight, pose, T_world_guess)
        if pose is not None and is_vague and not self._resembles(sight, pose):
            self._tracks.clear()  # nothing that was found is kept
            return None
        if pose is not None and is_vague and self._makes_jump(sight, pose):
            # Not all of them are wrong, but which ones nobody knows; other tracks serve to begin anew.
            self._let_go_of_landmarks()
            return None
        return pose

    def _makes_jump(self, sight: Sight, pose: TrackedPose) -> bool:
        """Tell whether a vague pose makes a camera that went steadily jump: then it is wrong."""
        frame = sight.frame
        if self._is_after_gap or not self._motion.jumps_to(frame.t_source_ns, pose.T_world_cam):
            return False
        seen = f"{pose.num_inliers} of {len(pose.ids)} landmarks"
        logger.debug("frame %d: %s make the camera jump, which they are too few for", frame.frame_id, seen)
        return True

    def _possible(self, pose: TrackedPose | None) -> TrackedPose | None:
        """Give up a pose that the camera can't have got to in a gap."""
        if pose is None or self.whereabouts is None or self.whereabouts.holds(pose.T_world_cam):
            return pose
        self._has_gone_astray = True
        return None

    def _with_more(
        self, sight: Sight, pose: TrackedPose | None, T_world_guess: Array | None
    ) -> TrackedPose | None:
        """Look for landmarks that lost their track where a pose rests on few, and estimate it again."""
        T_world_cam = T_world_guess if pose is None else pose.T_world_cam
        few = _FEW_INLIERS_SHARE * self._settings.max_features
        if T_world_cam is None or (pose is not None and pose.num_inliers >= few):
            return pose
        wanted = round(few) - (0 if pose is None else pose.num_inliers)
        reach_px = _REACH_PX if pose is not None and pose.num_inliers >= MIN_INLIERS else _REACH_BLIND_PX
        recalled = self._map.recall(self._tracks, sight, T_world_cam, wanted=wanted, reach_px=reach_px)
        again = self._possible(self.pose(T_world_cam)) if len(recalled) else None
        if again is not None and (pose is None or again.num_inliers > pose.num_inliers):
            return again
        # What was recalled has proved nothing.
        self._tracks.keep(~np.isin(self._tracks.ids, recalled))
        return pose

    def _resembles(self, sight: Sight, pose: TrackedPose) -> bool:
        """Tell whether tracks that agree with a pose look as they did: in noise some fit any guess."""
        return self._map.resembles(self._tracks, sight, pose.T_world_cam, pose.ids[pose.inliers])

    def unhidden(self, sight: Sight, T_world_rest: Array) -> TrackedPose | None:
        """Pose of a camera that rests and lost sight of everything, by what can be seen again from there."""
        pose = self._with_more(sight, None, T_world_rest)
        if pose is None or (pose.num_inliers >= _LEAST_UNHIDDEN and self._resembles(sight, pose)):
            return pose
        self._let_go_of_landmarks()
        return None

    def _let_go_of_landmarks(self) -> None:
        """Follow no track of a landmark any more."""
        self._tracks.keep(self._map.world.landmarks.rows(self._tracks.ids) < 0)
