"""Watches how well each keyframe takes over the scale of those before, and says so where it hardly does.

A single camera knows no unit of length: what a step is, a keyframe has from the depths of landmarks that were
there before it. Where few are left, or what tracks say is far worse than their noise, each keyframe changes
the unit by chance, and the map shrinks or grows along the way though every frame has a pose.
"""

import logging
import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.epipolar import fundamental_matrix, sampson_px
from semcast.server.geometry.triangulation import parallax_deg
from semcast.server.geometry.weighting import MAD_TO_SIGMA, NoiseModel, fuse_confidence
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes before the newest that tell the depth of landmarks.
_NUM_BEFORE = 20
#: Tracks that must be there to tell how far from their epipolar lines they are.
_LEAST_TRACKS = 10
#: Keyframes whose median counts: a single one that hardly holds is made up for by those around it.
_NUM_COUNTED = 5
#: Relative error of scale taken over from one keyframe to the next, from which on it is weakly held. Sharp
#: recordings have up to .003, behind fading links too. Where the scale was lost on the way it was .022 to .14
#: in six runs, and .017 in one that this misses.
_WEAK = 0.02


class ScaleWatch:
    """Warns once where scale is weakly held.

    Args:
        camera: Pinhole.
    """

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera
        self._recent: deque[tuple[int, float]] = deque(maxlen=_NUM_COUNTED)
        self._has_told = False

    def look(self, world: WorldMap, noise: NoiseModel) -> None:
        """Look at the newest keyframe, once its landmarks are made."""
        if self._has_told:
            return
        error = handover_error(world, self._camera, noise)
        if error is None:
            return
        self._recent.append((world.keyframes[-1].frame_id, error))
        typical = float(np.median([error for _, error in self._recent]))
        if len(self._recent) < _NUM_COUNTED or typical < _WEAK:
            return
        self._has_told = True
        logger.warning(
            "scale is weakly held since frame %d: each keyframe has the unit of length from those before "
            "with an error of about %.0f %%, so the path may shrink or grow along the way (are images "
            "blurred, noisy or far apart?); told once",
            self._recent[0][0],
            100.0 * min(typical, 1.0),
        )


def handover_error(world: WorldMap, camera: Intrinsics, noise: NoiseModel) -> float | None:
    """Relative standard deviation with which the newest keyframe has its scale from those before.

    That of each older landmark's depth is its noise over its parallax, all of them together tell the scale,
    and tracks that are further from their epipolar lines than noise explains make all of it that much worse.

    Returns:
        None for the first two keyframes of a submap, whose scale is what it is.
    """
    newest = world.keyframes[-1]
    before = world.keyframes_of(newest.submap)[-1 - _NUM_BEFORE : -1]
    if len(before) < 2:
        return None
    row = world.landmarks.rows(newest.ids)
    is_older = row >= 0
    is_older[is_older] = world.landmarks.born[row[is_older]] < newest.frame_id
    older = newest.ids[is_older]
    view, point, _, confidence, _ = gather_observations(before, older)
    centre = np.stack([k.T_world_cam[:3, 3] for k in before])[view]
    xyz = world.landmarks.xyz[row[is_older]]
    angle = np.radians(parallax_deg(centre, xyz, point, len(older)))
    count = np.maximum(1, np.bincount(point, minlength=len(older)))
    variance_px2 = np.bincount(point, noise.sigma_px(confidence) ** 2, minlength=len(older)) / count
    told = angle > 0.0
    # Both ends of the angle are observed.
    precision = float(((angle[told] * camera.fx) ** 2 / (2.0 * variance_px2[told])).sum())
    misfit = _misfit(camera, noise, before[-1], newest, newest.ids[~is_older])
    return misfit / math.sqrt(max(precision, 1e-12))


def _misfit(camera: Intrinsics, noise: NoiseModel, before: Keyframe, newest: Keyframe, ids: Ids) -> float:
    """How many times as far from their epipolar lines tracks are as their noise says, 1 at least."""
    shared = np.intersect1d(ids, before.ids, assume_unique=True)
    if len(shared) < _LEAST_TRACKS:
        return 1.0
    row0, row1 = (np.searchsorted(k.ids, shared) for k in (before, newest))
    F = fundamental_matrix(camera, invert_transform(newest.T_world_cam) @ before.T_world_cam)
    sigma = noise.sigma_px(fuse_confidence(before.confidence[row0], newest.confidence[row1]))
    size = np.abs(sampson_px(F, before.xy[row0], newest.xy[row1])) / sigma
    return max(1.0, MAD_TO_SIGMA * float(np.median(np.nan_to_num(size))))
