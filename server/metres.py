"""The metre of a map that grows: a printed marker in its keyframes tells what a unit of each part is.

Beside the map and after the pose: nothing in the map depends on it. Where images show a marker is kept; its
place and size in the map are found anew whenever a keyframe that shows it has moved: adjustments, closed
loops and joins of parts need no other care.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import make_transform
from semcast.server.export.markers import MarkerPlacement, Sightings
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate, Marker
from semcast.server.marker_settings import MarkerSettings

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: Sightings kept of a marker: of more than that every second old one goes.
_MAX_SIGHTINGS = 200
#: The unit is told again when it is known so much better.
_MUCH_BETTER = 0.5


class Metres:
    """What a unit of each part of a map is, and where the parts are in the frame of a marker.

    The marker is the same for all parts and maps of a stream: the one that is named, or the first that gives
    a unit.

    Args:
        settings: Which marker.
        camera: Of the decoded images.
        reconstruction: Whose map.
    """

    def __init__(self, settings: MarkerSettings, camera: Intrinsics, reconstruction: Reconstruction) -> None:
        self._settings = settings
        self._camera = camera
        self._reconstruction = reconstruction
        self._marker_id = settings.marker_id
        self._sightings = Sightings(settings.dictionary) if settings.side_m is not None else None
        self.reset()

    def reset(self) -> None:
        """Forget the map; the marker stays the one it is."""
        if self._sightings is not None:
            self._sightings.of.clear()
        self._why_not = ""
        self._told: dict[int, float] = {}
        #: Of each part.
        self._found: dict[int, MarkerPlacement] = {}
        self._shown: Marker | None = None

    def of(self, result: FrameResult) -> MarkerPlacement | None:
        """Return what is known of the part of the map a frame is in."""
        return self._found.get(result.submap)

    def follow(
        self, update: MapUpdate | None, frame: DecodedFrame | None = None, result: FrameResult | None = None
    ) -> MapUpdate | None:
        """Take what changed in the map, and return it with where the marker is now.

        Args:
            update: What changed.
            frame: The newest one, if that changed it.
            result: What became of that.
        """
        if self._sightings is None or update is None:
            return update
        try:
            if frame is not None and result is not None and result.is_keyframe:
                grey = cv2.cvtColor(self._reconstruction.put_right(frame.image), cv2.COLOR_RGB2GRAY)
                self._sightings.look(frame.frame_id, np.asarray(grey, dtype=np.uint8))
            moved = set(update.keyframe_ids.tolist())
            if any(moved & seen.keys() for seen in self._sightings.of.values()):
                self._place(self._sightings)
        except Exception as err:
            logger.exception("the marker is no longer looked for")
            self._why_not, self._sightings, self._found, self._shown = str(err), None, {}, None
        return replace(update, marker=self._shown)

    def _place(self, sightings: Sightings) -> None:
        """Find the marker anew in every part that shows it."""
        world = self._reconstruction.world
        for seen in sightings.of.values():
            if len(seen) > _MAX_SIGHTINGS:
                for frame_id in sorted(seen)[: _MAX_SIGHTINGS // 2 : 2]:
                    del seen[frame_id]
        assert self._settings.side_m is not None
        by_part: dict[int, dict[int, Array]] = {}
        for frame_id in {k for seen in sightings.of.values() for k in seen}:
            if frame_id in world.poses:
                by_part.setdefault(world.submap_of[frame_id], {})[frame_id] = world.poses[frame_id]
        self._found = {}
        for part, T_world_cam in sorted(by_part.items()):
            try:
                found = sightings.place(T_world_cam, self._camera, self._settings.side_m, self._marker_id)
            except SourceError as err:
                self._why_not = str(err)
                continue
            self._marker_id, self._found[part] = found.marker_id, found
            if found.relative_sigma < _MUCH_BETTER * self._told.get(part, np.inf):
                self._told[part] = found.relative_sigma
                self._tell(part, found)
        best = max(self._found.values(), key=lambda found: found.num_images, default=None)
        self._shown = None if best is None else Marker(best.corners_map, best.words)

    def _tell(self, part: int, found: MarkerPlacement) -> None:
        logger.info("%s%s", found.words, f" (part {part})" if part else "")

    def tell(self) -> None:
        """Say at the end of a stream what is known, or why nothing is."""
        for part, found in self._found.items():
            self._tell(part, found)
        if self._settings.side_m is None or self._found:
            return
        if not self._why_not and self._sightings is not None:
            self._why_not = self._sightings.none_found(self._marker_id)
        logger.warning("the metre is not known: %s", self._why_not)

    def summary(self) -> list[dict[str, Any]] | None:
        """Return what is known of each part, as plain values; None where no marker was asked for."""
        if self._settings.side_m is None:
            return None
        return [
            {
                "part": part,
                "marker_id": found.marker_id,
                "num_keyframes": found.num_images,
                "m_per_unit": found.scale,
                "relative_sigma": found.relative_sigma,
                "T_marker_world": make_transform(found.R, found.t).tolist(),
            }
            for part, found in sorted(self._found.items())
        ]

    def arrays(self) -> dict[str, NDArray]:
        """Return what a checkpoint keeps of it."""
        of = {} if self._sightings is None else self._sightings.of
        rows = [(number, frame_id, xy) for number, seen in of.items() for frame_id, xy in seen.items()]
        return {
            "marker.ids": np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2),
            "marker.corners_xy": np.array([row[2] for row in rows]).reshape(-1, 4, 2),
        }

    def restore(self, arrays: Mapping[str, NDArray]) -> None:
        """Go on with the map of a checkpoint, which may be of a server that looked for no marker.

        Raises:
            ValueError: Arrays contradict each other.
        """
        if self._sightings is None or "marker.ids" not in arrays:
            return
        for (number, frame_id), xy in zip(arrays["marker.ids"], arrays["marker.corners_xy"], strict=True):
            self._sightings.of.setdefault(int(number), {})[int(frame_id)] = np.array(xy)
        self._place(self._sightings)
