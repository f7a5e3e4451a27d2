"""Whether something passes before a camera that stands still, however much of the view it takes up.

What moves in most of the image is taken for the scene, and what stands there for a part of the car
(``standing``). At traffic lights, where others cross, it is the other way round. What hides what tells one
from the other: nothing is nearer than what moves with the camera, and what moves behind it neither hides it
nor uncovers it. So where things that move take places in which something stood, and give them back, it is
the scene that stands.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.sight import Sight
from semcast.server.mapping.standing import least_motion_px, scene_motion_px
from semcast.server.mapping.track_ids import shared_rows

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Tracks that a place has on average, where there are as many as there may be.
_TRACKS_EACH = 2.0
#: What moves by this share of the width from one frame to the next passes,
_PASSING_SHARE = 0.01
#: if that is so many times what a track moves at most that stands: between them is what comes to rest.
_PASSING_RATIO = 2.0
#: Share of the places with tracks that must stand, and that must pass. Where a camera comes to rest or sets
#: off, all of them change, but at once.
_MIXED_SHARE = 0.15
#: What a place counts that has changed hands, as a share of what it counted with the frame before.
_KEPT = 0.85
#: So much must be counted, and this share of the places that stood last. Before crossing traffic it rises to
#: 0.4 and more; with 0.3 that is too late for a start among fast cars. Along the outline of a dashboard it
#: has been 0.28 for a second of a drive.
_LEAST_TURNED, _TURNED_SHARE = 8.0, 0.2
#: For so long at most it is asked whether what stood is where it was. Far down a corridor, and behind a fence
#: that a camera goes along, all stands from one frame to the next; for longer, tracks that stand drift too.
_PROOF_NS = 1_000_000_000
#: For how long that is remembered while what stood goes on to stand, or is hidden.
_MEMORY_NS = 2_000_000_000
#: Share of what stood that must be seen to tell whether it still does.
_LEAST_LEFT = 0.2
_NOTHING, _STANDS, _PASSES = 0, 1, 2


@dataclass
class _Memory:
    """What is known before a frame; arrays are replaced and never changed.

    Attributes:
        was: Of each place, whether what was seen there last stands or passes.
        turned: What each counts that has changed hands.
        ids: ``(N,)`` of what stands.
        xy: ``(N, 2)`` where.
        noted_ns: Since when.
        until_ns: For how long what moves is held to pass; None while it is not.
    """

    was: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    turned: Array = field(default_factory=lambda: np.zeros(0))
    ids: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    xy: Array = field(default_factory=lambda: np.zeros((0, 2)))
    noted_ns: int | None = None
    until_ns: int | None = None


class Passing:
    """Remembers which places of the image stood and which moved, and what stood when something passed.

    Args:
        max_features: Tracks of the scene, at most.
        turntable: The scene is what moves, and all that stands is none.
    """

    def __init__(self, max_features: int, turntable: bool = False) -> None:
        self._max_features = max_features
        self._turntable = turntable
        self._now = self._before = _Memory()
        self._frame_id: int | None = None

    @property
    def camera_stands(self) -> bool:
        """Whether what moves in the newest image passes before a scene at rest."""
        return self._now.until_ns is not None

    def renew(self, before: Ids, after: Ids) -> None:
        """Know tracks by the ids ``after`` that they have now instead of ``before``, both ascending."""
        ids = self._now.ids.copy()
        alive = np.isin(ids, before)
        ids[alive] = after[np.searchsorted(before, ids[alive])]
        self._now = replace(self._now, ids=ids)

    def scene_motion_px(
        self, sight: Sight, ids: Ids, xy: Array, motion_px: Array, sd_px: Array, fixed: NDArray[np.bool_]
    ) -> float:
        """How far the scene moved from one frame to the next; not at all where the camera stands.

        Args:
            sight: The newer frame. Seen again, what it showed at first is forgotten.
            ids: ``(N,)`` of the tracks it shows, ascending.
            xy: ``(N, 2)`` where they are.
            motion_px: ``(N,)`` how far each moved.
            sd_px: ``(N,)`` standard deviation of a position per coordinate.
            fixed: ``(N,)`` which are known to move with the camera.
        """
        shape_hw, t_ns = sight.grey.shape, sight.frame.t_source_ns
        if sight.frame.frame_id != self._frame_id:
            self._before, self._frame_id = self._now, sight.frame.frame_id
        self._now = replace(self._before)
        if self._turntable:
            return scene_motion_px(xy, motion_px, shape_hw[1], sd_px)
        least_px = least_motion_px(shape_hw[1], sd_px)
        is_over = self._now.until_ns is not None and t_ns > self._now.until_ns
        if is_over or self._have_moved(ids, xy, least_px):
            self._now = _Memory()
        goes = motion_px >= np.maximum(_PASSING_SHARE * shape_hw[1], _PASSING_RATIO * least_px)
        stands = (motion_px <= least_px) & ~fixed
        has_passed = self._has_passed(xy, stands, goes, shape_hw)
        if has_passed:
            self._now.until_ns = t_ns + _MEMORY_NS
        if has_passed or not self.camera_stands:
            self._note(ids[stands], xy[stands], t_ns)
        return 0.0 if self.camera_stands else scene_motion_px(xy, motion_px, shape_hw[1])

    def _has_passed(
        self, xy: Array, stands: NDArray[np.bool_], goes: NDArray[np.bool_], shape_hw: tuple[int, ...]
    ) -> bool:
        """Note what each place does, and tell whether enough of them have changed from one to the other."""
        size_px = np.sqrt(_TRACKS_EACH * shape_hw[0] * shape_hw[1] / self._max_features)
        num_rows, num_columns = (int(side // size_px) + 1 for side in shape_hw)
        column, row = np.clip((xy / size_px).astype(np.intp), 0, (num_columns - 1, num_rows - 1)).T
        place, count = row * num_columns + column, num_rows * num_columns
        has_standing = np.bincount(place[stands], minlength=count) > 0
        has_going = np.bincount(place[goes], minlength=count) > 0
        is_now = np.where(has_standing, _STANDS, np.where(has_going, _PASSES, _NOTHING))
        is_now[has_standing & has_going] = _NOTHING  # an outline, or letters on a scene
        if min((is_now == _STANDS).sum(), (is_now == _PASSES).sum()) < _MIXED_SHARE * len(np.unique(place)):
            self._now.was, self._now.turned = np.zeros(count, np.intp), np.zeros(count)
            return False
        if len(self._now.was) == 0:
            self._now.was, self._now.turned = is_now, np.zeros(count)
        has_turned = (np.minimum(self._now.was, is_now) == _STANDS) & (
            np.maximum(self._now.was, is_now) == _PASSES
        )
        # A place counts once, not each time: along the outline of a bonnet they change for ever.
        self._now.turned = np.where(has_turned, 1.0, _KEPT * self._now.turned)
        self._now.was = np.where(is_now == _NOTHING, self._now.was, is_now)
        num_standing = int((self._now.was == _STANDS).sum())
        return bool(self._now.turned.sum() >= max(_LEAST_TURNED, _TURNED_SHARE * num_standing))

    def _note(self, ids: Ids, xy: Array, t_ns: int) -> None:
        """Note what stands: what is known, where it stood at first, for as long as that proves something."""
        xy = xy.copy()
        if self._now.noted_ns is None or t_ns - self._now.noted_ns >= _PROOF_NS:
            self._now.noted_ns = t_ns
        else:
            then, now = shared_rows(self._now.ids, ids)
            xy[now] = self._now.xy[then]
        self._now.ids, self._now.xy = ids, xy

    def _have_moved(self, ids: Ids, xy: Array, least_px: Array) -> bool:
        """Whether most of what stood does not any more: the camera has set off.

        Where few are left, it is those that an outline took along as it hid the rest.
        """
        then, now = shared_rows(self._now.ids, ids)
        moved_px = np.linalg.norm(xy[now] - self._now.xy[then], axis=1)
        enough = len(now) > 0 and len(now) >= _LEAST_LEFT * len(self._now.ids)
        return enough and float(np.median(moved_px / least_px[now])) > 1.0
