"""The metre of a map that grows: a printed marker in its keyframes tells what a unit of each part is.

Beside the map and after the pose: nothing in the map depends on it. Where images show a marker is kept; its
place and size in the map are found anew whenever a keyframe that shows it has moved: adjustments, closed
loops and joins of parts need no other care.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError, tell_nobody
from semcast.common.geometry import make_transform
from semcast.common.run_folder import PartInMetres
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
        on_give_up: Is told why, when the marker is no longer looked for.
    """

    def __init__(
        self,
        settings: MarkerSettings,
        camera: Intrinsics,
        reconstruction: Reconstruction,
        on_give_up: Callable[[str], None] = tell_nobody,
    ) -> None:
        self._settings = settings
        self._camera = camera
        self._reconstruction = reconstruction
        self._on_give_up = on_give_up
        self._marker_id = settings.marker_id
        self._sightings = Sightings(settings.dictionary) if settings.side_m is not None else None
        self.reset()

    def reset(self) -> None:
        """Forget the map; the marker stays the one it is."""
        if self._sightings is not None:
            self._sightings.of.clear()
        self._why_not = ""
        self._told: dict[int, MarkerPlacement] = {}
        #: Of each part, by these poses of keyframes in these parts.
        self._found: dict[int, MarkerPlacement] = {}
        self._found_by: dict[int, tuple[int, Array]] = {}
        self._shown: Marker | None = None

    def of(self, result: FrameResult) -> MarkerPlacement | None:
        """Return the way to metres of a frame that has a pose, None where none is known.

        It is that of the map as it is now: an adjustment may have moved it since the frame before.
        """
        if result.T_world_cam is None:
            return None
        self._guarded(self._place)
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
        if frame is not None and result is not None and result.is_keyframe:
            self._guarded(partial(self._look, frame))
        self._guarded(self._place)
        return replace(update, marker=self._shown)

    def _guarded(self, act: Callable[[Sightings], None]) -> None:
        """Do something with what was seen; a failure ends the search for the marker and nothing else."""
        if self._sightings is None:
            return
        try:
            act(self._sightings)
        except Exception as err:
            logger.exception("the marker is no longer looked for")
            self._why_not, self._sightings, self._found, self._shown = str(err), None, {}, None
            self._on_give_up(f"the marker is no longer looked for: {err}")

    def _look(self, frame: DecodedFrame, sightings: Sightings) -> None:
        grey = cv2.cvtColor(self._reconstruction.put_right(frame.image), cv2.COLOR_RGB2GRAY)
        sightings.look(frame.frame_id, np.asarray(grey, dtype=np.uint8))
        for seen in sightings.of.values():
            if len(seen) > _MAX_SIGHTINGS:
                for frame_id in sorted(seen)[: _MAX_SIGHTINGS // 2 : 2]:
                    del seen[frame_id]

    def _place(self, sightings: Sightings) -> None:
        """Find the marker anew in all parts, if a keyframe that shows it is new or has moved."""
        world = self._reconstruction.world
        numbers = sightings.of.keys() if self._marker_id is None else {self._marker_id}
        shown_in = {k for number in numbers for k in sightings.of.get(number, ())}
        by = {k: (world.submap_of[k], world.poses[k]) for k in sorted(shown_in & world.poses.keys())}
        if _are_alike(by, self._found_by):
            return
        self._found_by, self._found = {k: (part, T.copy()) for k, (part, T) in by.items()}, {}
        assert self._settings.side_m is not None
        for part in sorted({part for part, _ in by.values()}):
            T_world_cam = {k: T for k, (its_part, T) in by.items() if its_part == part}
            try:
                found = sightings.place(T_world_cam, self._camera, self._settings.side_m, self._marker_id)
            except SourceError as err:
                self._why_not = str(err)
                continue
            self._marker_id, self._found[part] = found.marker_id, found
            told = self._told.get(part)
            if told is None or found.relative_sigma < _MUCH_BETTER * told.relative_sigma:
                self._tell(part, found)
        # A part that is joined leaves its number to a later one.
        self._told = {part: told for part, told in self._told.items() if part in self._found}
        best = max(self._found.values(), key=lambda found: found.num_images, default=None)
        self._shown = None if best is None else Marker(best.corners_map, best.words)

    def _tell(self, part: int, found: MarkerPlacement) -> None:
        self._told[part] = found
        logger.info("%s%s", found.words, f" (part {part})" if part else "")

    def tell(self) -> None:
        """Say at the end of a stream what is known, or why nothing is."""
        for part, found in self._found.items():
            if self._told.get(part) is not found:
                self._tell(part, found)
        if self._settings.side_m is None or self._found:
            return
        if not self._why_not and self._sightings is not None:
            self._why_not = self._sightings.none_found(self._marker_id)
        logger.warning("the metre is not known: %s", self._why_not)

    def parts(self) -> tuple[PartInMetres, ...]:
        """Return what is known of each part of the map as it is now, in the order of their numbers."""
        self._guarded(self._place)
        return tuple(
            PartInMetres(
                part=part,
                marker_id=found.marker_id,
                num_keyframes=found.num_images,
                m_per_unit=found.scale,
                relative_sigma=found.relative_sigma,
                T_marker_world=make_transform(found.R, found.t),
            )
            for part, found in sorted(self._found.items())
        )

    def summary(self) -> list[dict[str, Any]] | None:
        """Return the same as plain values; None where no marker was asked for."""
        return None if self._settings.side_m is None else [part.to_dict() for part in self.parts()]

    def arrays(self) -> dict[str, NDArray]:
        """Return what a checkpoint keeps of it."""
        of = {} if self._sightings is None else self._sightings.of
        rows = [(number, frame_id, xy) for number, seen in of.items() for frame_id, xy in seen.items()]
        return {
            "marker.family": np.array(self._settings.dictionary),
            "marker.chosen": np.array([] if self._marker_id is None else [self._marker_id], dtype=np.int64),
            "marker.ids": np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2),
            "marker.corners_xy": np.array([row[2] for row in rows]).reshape(-1, 4, 2),
        }

    def restore(self, arrays: Mapping[str, NDArray]) -> None:
        """Go on with the map of a checkpoint, also of a server that looked for none or another family.

        Raises:
            ValueError: Arrays contradict each other.
        """
        if self._sightings is None or str(arrays.get("marker.family")) != self._settings.dictionary:
            return
        for (number, frame_id), xy in zip(arrays["marker.ids"], arrays["marker.corners_xy"], strict=True):
            self._sightings.of.setdefault(int(number), {})[int(frame_id)] = np.array(xy)
        if self._marker_id is None and len(chosen := arrays["marker.chosen"]):
            self._marker_id = int(chosen[0])
        self._place(self._sightings)


def _are_alike(one: Mapping[int, tuple[int, Array]], other: Mapping[int, tuple[int, Array]]) -> bool:
    """Tell whether keyframes are the same, in the same parts and at the same poses."""
    if one.keys() != other.keys() or any(one[k][0] != other[k][0] for k in one):
        return False
    return np.array_equal([T for _, T in one.values()], [T for _, T in other.values()])
