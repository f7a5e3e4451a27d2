"""Whether the motion of the newest keyframes is contradicted by what tracks say of it without the map.

Past a blank corner the few landmarks that are left leave a pose to chance; what is triangulated from there is
bent, and holds the next poses to its own bend. In front of something flat that can fit for long: a flat scene
allows two motions (``planar_ambiguity``), and the wrong one is a minimum of its own, which neither the pose
of a frame nor an adjustment leaves. Each frame has a pose then, and the path is nonsense. But how one of two
keyframes lies to the other is also told by their tracks alone. Where that fits the tracks far better than the
map does, and the landmarks among them too, the map is wrong: something that moves by itself has other tracks.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform
from semcast.server.geometry.epipolar import half_line_px, refine_relative_pose
from semcast.server.geometry.lo_ransac import lo_ransac
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]

#: Keyframes from one to the other of a pair.
_APART = 3
#: Tracks that both must see, and landmarks among them.
_MIN_TRACKS, _MIN_LANDMARKS = 50, 20
#: Errors are told in this many pixels, what tracks of usual images have, and cut off at so many of them.
_SIGMA_PX, _CUT = 0.3, 3.3
#: Mean squared error at the map's own poses up to which no others are looked for.
_GOOD = 1.0
#: How much larger the mean squared error of all tracks must be than at the pose that fits them best.
_FAR_WORSE = 0.5
#: What a refinement of that pose gains at most. It takes several times as long as the search, and is left out
#: where that can't matter.
_REFINED = 0.1
#: The same as _FAR_WORSE of the landmarks among the tracks.
_WORSE = 0.2
#: Of the newest pairs, how many must say so.
_NUM_PAIRS, _MIN_PAIRS = 4, 3
#: Iterations of a search.
_ITERATIONS = 100
#: Keyframes that pass without a look where nothing better was found; each time in a row twice as many.
_PAUSE = 6
#: And so many at most.
_MAX_PAUSE = 192


class Contradiction:
    """Compares each keyframe with one before it.

    Args:
        camera: Pinhole.
        seed: Of the searches.
    """

    def __init__(self, camera: Intrinsics, seed: int) -> None:
        self._camera = camera
        self._seed = seed
        self._said: deque[bool] = deque(maxlen=_NUM_PAIRS)
        self._pause = self._vain_pause = 0

    def look(self, world: WorldMap, submap: int) -> bool:
        """Look at the newest keyframe of a submap; whether it and those before it are contradicted."""
        self._pause -= 1
        if self._pause >= 0:
            return False
        mine = world.keyframes_of(submap)[-1 - _APART :]
        if len(mine) <= _APART or (says := self._says(world, mine[0], mine[-1])) is None:
            return False
        self._said.append(says)
        return says and sum(self._said) >= _MIN_PAIRS

    def note(self, *, was_right: bool) -> None:
        """Note that the map was put right, or that nothing was found to be better."""
        self._said.clear()
        self._vain_pause = 0 if was_right else min(max(_PAUSE, 2 * self._vain_pause), _MAX_PAUSE)
        self._pause = self._vain_pause

    def _says(self, world: WorldMap, first: Keyframe, second: Keyframe) -> bool | None:
        """Whether tracks of two keyframes contradict their poses; None where too few tell."""
        row0, row1 = shared_rows(first.ids, second.ids)
        is_landmark = world.landmarks.rows(first.ids[row0]) >= 0
        if len(row0) < _MIN_TRACKS or int(is_landmark.sum()) < _MIN_LANDMARKS:
            return None
        T_mapped = invert_transform(second.T_world_cam) @ first.T_world_cam
        way = float(np.linalg.norm(T_mapped[:3, 3]))
        if way == 0.0:
            return None
        T_mapped = make_transform(T_mapped[:3, :3], T_mapped[:3, 3] / way)
        xy0, xy1 = np.ascontiguousarray(first.xy[row0]), np.ascontiguousarray(second.xy[row1])
        mapped_px = half_line_px(self._camera, T_mapped, xy0, xy1)
        mapped = _squared(mapped_px)
        if mapped.mean() < _GOOD:
            return False
        T_best = self._search(xy0, xy1)
        if T_best is None:
            return False
        more = mapped - _squared(half_line_px(self._camera, T_best, xy0, xy1))
        if more.mean() > _FAR_WORSE - _REFINED:
            T_best = refine_relative_pose(self._camera, T_best, xy0, xy1, np.full(len(xy0), _SIGMA_PX))
            more = mapped - _squared(half_line_px(self._camera, T_best, xy0, xy1))
        return bool(more.mean() > _FAR_WORSE and more[is_landmark].mean() > _WORSE)

    def _search(self, xy0: Array, xy1: Array) -> Array | None:
        """Relative pose that fits tracks ``(N, 2)`` best, translation of length 1; None without one."""
        options = {
            "max_epipolar_error": _CUT * _SIGMA_PX,
            "min_iterations": _ITERATIONS // 2,
            "max_iterations": _ITERATIONS,
            "seed": self._seed,
        }
        return lo_ransac(self._camera, xy0, xy1, options)


def _squared(distance_px: Array) -> Array:
    """Squared errors in variances, each cut off."""
    size = np.nan_to_num(np.abs(distance_px) / _SIGMA_PX, nan=_CUT)
    return np.asarray(np.minimum(size, _CUT) ** 2)
