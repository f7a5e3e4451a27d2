"""Keypoint tracks: points followed from image to image, with the confidence of their newest position."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.cells import cell_keys
from semcast.server.geometry.corners import corner_strength, deduplicate, detect_corners
from semcast.server.geometry.flicker import flicker_between
from semcast.server.geometry.klt import TrackedPoints, track_alike, track_through_light
from semcast.server.geometry.sampling import sample_map
from semcast.server.geometry.warped_points import MAX_FROM_GUESS_PX, track_warped
from semcast.server.geometry.weighting import (
    ConfidenceMode,
    KeypointCues,
    localisation_variance_px2,
    observation_confidence,
    observation_edges,
    variance_confidence,
)
from semcast.server.mapping.found import Found
from semcast.server.mapping.passing import Passing
from semcast.server.mapping.recent_images import RecentImages
from semcast.server.mapping.sight import Seen, Sight
from semcast.server.mapping.standing import is_fixed, may_be_fixed, stood

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Frames for which a track may be out of sight, as long as the image is what is missing.
MAX_COAST = 3
#: A point nearer than this to rows that did not arrive counts as hidden. What the decoder makes of such rows
#: fits what is around them: a window may reach into them, and does until only its middle row is left.
_LOST_MARGIN_PX = 1
#: Share of tracks that must be found again; below, the frame counts as damaged and all tracks coast.
_MIN_FOUND_SHARE = 0.35
#: A track this far from where descriptors lead to has found something else.
_REFUTED_PX = 3.0
#: Side of the cells that tell which tracks are beside a point.
_BESIDE_PX = 4.0
#: What a track has, by attribute of ``TrackTable``.
_MOTION = ("ids", "xy", "velocity", "confidence", "variance_px2", "drift_px2", "age", "missed")
_COLUMNS = (*_MOTION, "anchor_xy", "stood_widths", "edge")
#: Share of an image's localisation variance that stays with a point followed on from it. Most of it goes with
#: the image: the next step begins where this one ended, and takes its error back. Measured against tracks of
#: the original images.
_KEPT_VARIANCE = 0.2


class TrackTable:
    """All tracks that are alive.

    Attributes:
        next_id: Of the next track.
        ids: ``(N,)`` int64, ascending.
        xy: ``(N, 2)`` newest position, in the image of its last sight.
        velocity: ``(N, 2)`` pixels per frame at the last sight.
        confidence: ``(N,)`` of the newest position.
        variance_px2: ``(N,)`` of the newest position, as its image alone makes it.
        drift_px2: ``(N,)`` variance that a next position takes over from those before.
        age: ``(N,)`` int64, frames it was seen in.
        missed: ``(N,)`` int64, frames since its last sight; 0 is visible now.
        anchor_xy: ``(N, 2)`` where it began to stand still in the image.
        stood_widths: ``(N,)`` image widths the scene went since then.
        edge: ``(N, 2)`` of the newest position, see ``edges``.
        passing: What passes before the scene.
    """

    def __init__(self, mode: ConfidenceMode, max_features: int, seed: int, turntable: bool = False) -> None:
        self._mode: ConfidenceMode = mode
        self._max_features = max_features
        self._rng = np.random.default_rng(seed)
        self.next_id = 0
        self._images = RecentImages(MAX_COAST)
        self._jumped = False
        self.passing = Passing(max_features, turntable)
        self.clear()

    def clear(self) -> None:
        """Forget all tracks; ids go on."""
        self.adopt(np.zeros(0, np.int64), np.zeros((0, 2)), 0.0)

    def adopt(self, ids: Ids, xy: Array, confidence: float) -> None:
        """Replace all tracks by points of the newest image, as after relocalisation.

        Ids that occur twice are taken once.
        """
        self._before: dict[str, Array] | None = None
        distinct, first = np.unique(ids, return_index=True)
        count = len(first)
        self.ids: Ids = distinct
        self.xy: Array = xy[first]
        self.velocity: Array = np.zeros((count, 2))
        self.confidence: Array = np.full(count, confidence)
        self.variance_px2: Array = np.zeros(count)
        self.drift_px2: Array = np.zeros(count)
        self.age: Ids = np.ones(count, np.int64)
        self.missed: Ids = np.zeros(count, np.int64)
        self.anchor_xy: Array = self.xy.copy()
        self.stood_widths: Array = np.zeros(count)
        self.edge: Array = np.zeros((count, 2))

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Tracks of the scene that are seen in the newest image."""
        return np.asarray((self.missed == 0) & ~self.fixed)

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Tracks on something that moves with the camera: followed, lest it is taken for the scene again."""
        return is_fixed(self.stood_widths)

    @property
    def suspect(self) -> NDArray[np.bool_]:
        """Tracks that may be on something that moves with the camera; nothing should rest on them yet."""
        return may_be_fixed(self.stood_widths)

    def vouch(self, ids: Ids) -> None:
        """Tracks that agree with the pose are of the scene, however still they stand."""
        self.stood_widths = np.where(np.isin(self.ids, ids), 0.0, self.stood_widths)

    def seen(self) -> Seen:
        """Tracks that are visible now."""
        return Seen(self.ids, self.xy, self.confidence, self.edge)[self.visible]

    @property
    def frame_ids(self) -> list[int]:
        """Frames of the images tracks are followed from, newest first: ``missed`` is an index into them."""
        return self._images.frame_ids

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Forget tracks outside the mask."""
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[mask])

    def as_they_are(self) -> dict[str, object]:
        """All there is, for ``put_back``."""
        # Arrays are replaced and never written to.
        return {**vars(self), "_images": copy(self._images), "passing": copy(self.passing)}

    def put_back(self, kept: dict[str, object]) -> None:
        """Let tracks be what they were when ``as_they_are`` was called."""
        vars(self).update(kept)

    def renew(self, others: Ids) -> tuple[Ids, Ids]:
        """Give all tracks new ids, as if they began now, and ids kept elsewhere with them.

        New ids are consecutive, whatever lies between the old ones: moved by one sum, those of landmarks of
        long ago would double the range each time.

        Args:
            others: ``(N,)`` ids kept elsewhere, in any order; those of tracks may be among them.

        Returns:
            The ids that were, ascending, and the new one of each, ascending too.
        """
        before = np.union1d(self.ids, others)
        after = self.next_id + np.arange(len(before), dtype=np.int64)
        self.ids = after[np.searchsorted(before, self.ids)]
        self.next_id += len(before)
        self.passing.renew(before, after)
        self._before = None
        return before, after

    def follow(self, sight: Sight, guess_xy: Array, max_level: int = 3) -> None:
        """Look for every track in a new image.

        A track that runs into rows that did not arrive coasts: it is looked for again from the image it was
        last seen in. When hardly any is found, the image jumped, and tracks are found by descriptors; or it
        is at fault, and all coast.

        Args:
            sight: The new image.
            guess_xy: ``(N, 2)`` expected positions.
            max_level: KLT pyramid levels.
        """
        self._before = {name: getattr(self, name).copy() for name in _COLUMNS}
        self._jumped = False
        found = Found.nothing(self.xy)
        guess_xy = np.where(self.fixed[:, None], self.xy, guess_xy)
        is_in_light = False
        behind, count = np.unique(self.missed[self.missed < len(self._images)], return_counts=True)
        # Those that are most come first: of one image all the others may be, and a few can't tell the light.
        for back in behind[np.argsort(-count, kind="stable")]:
            rows = np.flatnonzero(self.missed == back)
            way = self.xy[rows], guess_xy[rows]
            if not is_in_light:
                gains = flicker_between(self._images[back], sight.grey, *way, sight.usable)
                self._images.bring_to_lamps(gains)
            grey = self._images[back]
            images = self._images.blurred_alike(back, sight)
            if is_in_light:
                points = track_alike(*images, *way, max_level=max_level)
            else:
                points, change = track_through_light(*images, *way, max_level=max_level)
                self._images.bring_to_light(change)
                grey, is_in_light = self._images[back], True
            found.take(rows, points)
            if not sight.usable.all():
                found.look_again(grey, sight.grey, self.xy, guess_xy, rows)
        hidden = self._hidden(sight, found, guess_xy)
        coasting = hidden & ~found.ok
        of_scene = ~self.fixed
        if (found.ok & of_scene).sum() < _MIN_FOUND_SHARE * max(1, int((of_scene & ~hidden).sum())):
            jumped = self._jump(sight, found) if len(self._images) else False
            self._jumped = True
            coasting = self._hidden(sight, found, guess_xy) & ~found.ok if jumped else ~found.ok
        self._settle(sight, found, coasting)
        self.remember(sight)

    def follow_again(self, sight: Sight, guess: Callable[["TrackTable"], Array]) -> bool:
        """Look again for what ``follow`` just looked for, from another guess.

        Args:
            sight: The image ``follow`` was given.
            guess: Expected positions ``(N, 2)`` of tracks as they were before.

        Returns:
            Whether there was anything to look for.
        """
        if self._before is None or len(self._images) < 2:
            return False
        self._take_back()
        self.follow(sight, guess(self))
        return True

    def _take_back(self) -> None:
        """Let the tracks be as they were before the newest image, and forget that."""
        assert self._before is not None
        for name, values in self._before.items():
            setattr(self, name, values)
        self._before = None
        self._images.drop_newest()

    def follow_jump(self, sight: Sight) -> bool:
        """Look again for what ``follow`` just looked for, by descriptors.

        For an image in which tracks were found, but not where they are. Without success all stays as it was.

        Returns:
            Whether more was found.
        """
        if self._before is None or self._jumped or len(self._images) < 2:
            return False
        after = {name: getattr(self, name) for name in _COLUMNS}
        self._take_back()
        found = Found.nothing(self.xy)
        row = np.searchsorted(self.ids, after["ids"])
        found.ok[row], found.xy[row] = after["missed"] == 0, after["xy"]
        found.ok &= self.missed == 0
        jumped = self._jump(sight, found)
        hidden = self._hidden(sight, found, self.xy)
        self.remember(sight)
        if not jumped:
            for name, values in after.items():
                setattr(self, name, values)
            return False
        self._settle(sight, found, hidden & ~found.ok)
        return True

    def _hidden(self, sight: Sight, found: Found, guess_xy: Array) -> NDArray[np.bool_]:
        """Which tracks are, or would be, next to rows that did not arrive; none of them counts as found."""
        hidden = sight.near_lost(np.where(found.ok[:, None], found.xy, guess_xy), _LOST_MARGIN_PX)
        found.ok &= ~hidden
        return hidden

    def _jump(self, sight: Sight, found: Found) -> bool:
        """Find tracks of the last image by descriptors; whether that found more.

        Of those found before, the ones elsewhere than descriptors say don't count: Lucas-Kanade finds
        something near any guess.
        """
        rows = np.flatnonzero(self.missed == 0)
        jump = self._images.search_jump(sight, self.xy[rows])
        if jump is None:
            return False
        points = track_warped(self._images[0], sight.grey, self.xy[rows], jump.xy, jump.warps)
        refuted = np.linalg.norm(found.xy[rows] - jump.xy, axis=1) > MAX_FROM_GUESS_PX
        refuted |= points.ok & (np.linalg.norm(found.xy[rows] - points.xy, axis=1) > _REFUTED_PX)
        shown = points.ok & ~sight.near_lost(points.xy, _LOST_MARGIN_PX)
        if shown.sum() <= (found.ok[rows] & ~refuted).sum():
            return False
        found.take(rows, points)
        return True

    def _settle(self, sight: Sight, found: Found, coasting: NDArray[np.bool_]) -> None:
        """Move tracks to where they were found, and forget those that neither were nor coast."""
        ok = found.ok
        steps = (self.missed + 1)[:, None]
        self.velocity = np.where(ok[:, None], (found.xy - self.xy) / steps, self.velocity)
        self.xy = np.where(ok[:, None], found.xy, self.xy)
        self.age = self.age + ok
        motion_px, sd_px = np.linalg.norm(self.velocity[ok], axis=1), np.sqrt(self.variance_px2)
        of_ok = self.ids[ok], self.xy[ok], motion_px, sd_px[ok], self.fixed[ok]
        scene_px = self.passing.scene_motion_px(sight, *of_ok)
        passed = np.where(ok, scene_px, 0.0)  # where a track that coasts is, nobody knows
        still = self.anchor_xy, self.stood_widths
        self.anchor_xy, self.stood_widths = stood(self.xy, *still, passed, sight.grey.shape[1], sd_px)
        self.missed = np.where(ok, 0, self.missed + 1)
        cues = replace(
            self._cues(
                sight, found.xy[ok], found.forward_backward[ok], found.photometric[ok], found.gradient[ok]
            ),
            drift_px2=self.drift_px2[ok],
        )
        self.confidence, self.variance_px2 = self.confidence.copy(), self.variance_px2.copy()
        self.confidence[ok] = observation_confidence(self._mode, cues, self._rng)
        self.variance_px2[ok] = localisation_variance_px2(cues)
        self.edge = self.edge.copy()
        self.edge[ok] = cues.edge
        self.drift_px2 = self.drift_px2 + _KEPT_VARIANCE * np.where(ok, self.variance_px2, 0.0)
        alive = ok | (coasting & (self.missed <= MAX_COAST))
        alive[ok] &= deduplicate(self.xy[ok])
        self.keep(alive)

    def settle_at(self, rows: NDArray[np.intp], xy: Array, scatter_px2: Array) -> None:
        """Put visible tracks where they were found from images of long ago: they have no drift then.

        Args:
            rows: ``(M,)`` of the tracks.
            xy: ``(M, 2)`` where.
            scatter_px2: ``(M,)`` variance per coordinate of where the images have them, NaN where too few
                tell it. It takes the place of what is expected of an image.
        """
        self.xy = self.xy.copy()
        self.xy[rows] = xy
        self.drift_px2 = self.drift_px2.copy()
        self.drift_px2[rows] = 0.0
        if self._mode == "robust":
            self.confidence = self.confidence.copy()
            expected = self.variance_px2[rows]
            variance_px2 = np.where(np.isfinite(scatter_px2), scatter_px2, expected)
            self.confidence[rows] = variance_confidence(variance_px2)

    def beside(self, xy: Array) -> NDArray[np.bool_]:
        """Visible tracks next to ``(M, 2)`` points, ``(N,)``: in the same or a neighbouring cell."""
        around = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
        taken = (np.floor(xy / _BESIDE_PX).astype(np.int64)[:, None] + around).reshape(-1, 2)
        cells = np.floor(self.xy / _BESIDE_PX).astype(np.int64)
        return self.visible & np.isin(cell_keys(cells), cell_keys(taken))

    def bring_back(self, sight: Sight, ids: Ids, points: TrackedPoints) -> Ids:
        """Add tracks that ended earlier where they were found in the newest image.

        Those next to rows that did not arrive are left out, and of several in one place all but the first,
        tracks that are visible already before others.

        Args:
            sight: The newest image.
            ids: ``(N,)`` of the tracks, none of them alive.
            points: ``(N,)`` where they were found; those that are not ``ok`` are left out.

        Returns:
            Ids of those that were added.
        """
        ok = points.ok & ~sight.near_lost(points.xy, _LOST_MARGIN_PX)
        xy = points.xy[ok]
        taken = np.concatenate([self.xy[self.missed == 0], xy])
        ok[ok] = deduplicate(taken)[len(taken) - len(xy) :]
        taken_up: Ids = ids[ok]
        if len(taken_up) == 0:
            return taken_up
        xy = points.xy[ok]
        cues = self._cues(
            sight, xy, points.forward_backward_px[ok], points.photometric_grey[ok], points.gradient_grey2[ok]
        )
        self._append(taken_up, xy, cues)
        return taken_up

    def _append(self, ids: Ids, xy: Array, cues: KeypointCues) -> None:
        """Add tracks seen in the newest image, which are taken to move like those around; ids stay sorted."""
        around = self.velocity[self.visible]
        usual = np.median(around, axis=0) if len(around) else np.zeros(2)
        new = {
            "ids": ids,
            "xy": xy,
            "velocity": np.tile(usual, (len(ids), 1)),
            "confidence": observation_confidence(self._mode, cues, self._rng),
            "variance_px2": localisation_variance_px2(cues),
            "drift_px2": np.zeros(len(ids)),
            "age": np.ones(len(ids), np.int64),
            "missed": np.zeros(len(ids), np.int64),
            "anchor_xy": xy,
            "stood_widths": np.zeros(len(ids)),
            "edge": cues.edge,
        }
        order = np.argsort(np.concatenate([self.ids, ids]), kind="stable")
        for name in _COLUMNS:
            setattr(self, name, np.concatenate([getattr(self, name), new[name]])[order])

    def move(self, rows: NDArray[np.bool_], xy: Array) -> None:
        """Put visible tracks where they are in an image that was put right."""
        self.velocity, before = self.velocity.copy(), self.xy
        self.xy = before.copy()
        self.xy[rows] = xy
        self.velocity += self.xy - before

    def replace_newest(self, sight: Sight) -> None:
        """Take another version of the image that was taken last."""
        self._images.replace_newest(sight)

    def remember(self, sight: Sight) -> None:
        """Keep the image for tracks that are looked for in later ones."""
        self._images.append(sight)

    def refill(self, sight: Sight) -> int:
        """Start new tracks where there are none; the number started.

        ``remember`` or ``follow`` must have taken the image before.
        """
        wanted = self._max_features - int(self.visible.sum())
        if wanted < self._max_features // 20:
            return 0
        usable = None
        if not sight.usable.all():
            rows = ~sight.rows_near_lost(KLT_WINDOW_PX // 2)
            usable = np.repeat(rows[:, None], sight.grey.shape[1], axis=1)
        height, width = sight.grey.shape
        cell_px = int(np.clip(np.sqrt(height * width / max(1.0, self._max_features / 2.5)), 16, 96))
        strength = corner_strength(sight.grey)
        found = detect_corners(sight.grey, wanted, self.xy[self.missed == 0], usable, cell_px, strength)
        corners: Array = found.astype(np.float64)
        count = len(corners)
        if count == 0:
            return 0
        gradient = sample_map(strength, corners)
        cues = self._cues(sight, corners, np.full(count, 0.1), np.zeros(count), gradient)
        self._append(self.next_id + np.arange(count, dtype=np.int64), corners, cues)
        self.next_id += count
        return count

    def _cues(
        self, sight: Sight, xy: Array, forward_backward: Array, photometric: Array, gradient: Array
    ) -> KeypointCues:
        pixel, keypoint = sight.frame.confidence, sight.frame.keypoint_confidence
        return KeypointCues(
            pixel_confidence=None if pixel is None else sample_map(pixel, xy),
            keypoint_confidence=None if keypoint is None else sample_map(keypoint, xy),
            gradient_grey2=gradient,
            forward_backward_px=forward_backward,
            photometric_grey=photometric,
            edge=observation_edges(self._mode, sight.grey, xy),
        )
