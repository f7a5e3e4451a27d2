"""How a part of the map begins: of frames without a pose, which are kept until they make a start."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.initialiser import Initialiser
from semcast.server.mapping.kept_frames import backfill, observed_of
from semcast.server.mapping.look_back import look_back
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.submap_placement import SubmapPlacement
from semcast.server.mapping.tracks import TrackTable

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: A frame with fewer rows than this share is kept for its pose, not to start a map from.
_MIN_USABLE_SHARE = 0.5


class Beginning:
    """Keeps frames without a pose, and makes a part of the map of them.

    Args:
        camera: Pinhole.
        settings: Of the reconstruction.
        builder: Owns the map.
        tracks: Followed into each frame.
        motion: Tells where the camera was and how it went.
        placement: Tells where the new part begins.
    """

    def __init__(
        self,
        camera: Intrinsics,
        settings: ReconstructionSettings,
        builder: MapBuilder,
        tracks: TrackTable,
        motion: CameraMotion,
        placement: SubmapPlacement,
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._map = builder
        self._tracks = tracks
        self._motion = motion
        self._placement = placement
        self._initialiser = Initialiser(camera, settings.confidence, settings.min_parallax_deg, settings.seed)

    def clear(self) -> None:
        """Forget the frames kept so far."""
        self._initialiser.clear()

    def begin_submap(self) -> None:
        """Let the next start be a part of its own that shares no track with what came before.

        Keyframes hold tracks without a landmark too: if one got its landmark in the new part, the old part
        would be recognised by it, wherever the camera is.
        """
        self._map.begin_submap()
        self._initialiser.renew(*self._tracks.renew(self._initialiser.ids))

    def look(self, sight: Sight, *, is_lost: bool) -> Start | None:
        """Keep a frame without a pose for the start of a map, and try to start one with it.

        Args:
            sight: The image.
            is_lost: The map is still looked for, and none begins.
        """
        tracks = self._tracks
        tracks.refill(sight)
        # Tracks of old landmarks serve to find back, not to start anew: a landmark has one id.
        visible = tracks.visible & (self._map.world.landmarks.rows(tracks.ids) < 0)
        observed = observed_of(sight, tracks, visible)
        self._initialiser.leave_out(tracks.ids[tracks.fixed])
        waits = is_lost or tracks.passing.camera_stands
        waits |= float(sight.usable.mean()) < _MIN_USABLE_SHARE
        noise, suspect = self._map.noise.model, tracks.ids[tracks.suspect]
        return self._initialiser.add(observed, noise, suspect, waits=waits)

    def bring_in(self, sight: Sight, start: Start) -> tuple[Ids, tuple[tuple[int, int, Array], ...]]:
        """Bring a start into the map, grown backwards, and pose the frames that waited for it.

        Args:
            sight: The newest image.
            start: What ``look`` found with it.

        Returns:
            Ids of the landmarks; id, time and pose of the frames that waited.
        """
        history = self._initialiser.history
        self._map.finish()  # a new part is placed by where the old one ends
        grown = look_back(self._camera, start, history, self._map.noise.model, self._settings)
        place = self._placement.place(self._motion, start, grown, self._map.world, self._map.submap)
        self._map.take_start(grown, sight, self._tracks, place, history)
        noise, seed = self._map.noise.model, self._settings.seed
        backfilled = backfill(self._camera, self._map.world, grown.keyframes, history[:-1], noise, seed)
        self._motion.reset()
        self.clear()
        return grown.ids, backfilled
