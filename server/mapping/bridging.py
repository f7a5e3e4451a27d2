"""Pose and scale of a new submap, extrapolated from the camera's motion until something better is known."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.start_geometry import Start

Array = NDArray[np.float64]

#: A speed that is older than this says nothing of a new map's unit.
_MAX_BRIDGE_S = 5.0
#: The camera moved, where a new map's length is that of more than this share of the depth,
_LEAST_WAY = 0.02
#: and its unit makes things at most this many times as far or as near as they were.
_MOST_FARTHER = 5.0
#: Standard deviation of the logarithm of a new map's unit, guessed from things being as far away as before,
_DEPTH_SIGMA = 0.5
#: or from the camera going on at a speed that is as sure as this at best. To it come how much the speed
#: changed before, and the error of a speed in depths per second: of a slow camera, that is most of it.
_SPEED_SIGMA = 0.03
_SPEED_ERROR_DEPTHS_S = 0.03
#: Time after a gap from which it is told how the camera moves then: the shorter, the noisier.
_LATER_NS = 500_000_000


class Bridge(NamedTuple):
    """Where a new submap is guessed to be.

    Attributes:
        T_world_cam: ``(4, 4)`` of its first camera.
        scale: World units per unit of its start.
        covariance: What that is worth, as of ``GuessedPlace``; None where nothing tells.
    """

    T_world_cam: Array
    scale: float
    covariance: Array | None


def bridge(
    motion: CameraMotion,
    start: Start,
    grown: Start,
    last_ns: int | None,
    depth: float,
    turned: Sequence[tuple[int, Array]] = (),
) -> Bridge:
    """Estimate pose and scale of a new submap from how the camera moved before and after the gap.

    The scale is a weighted mean of two guesses: that the camera goes on at the speed expected of it, and that
    the scene is as far away as it was. The slower the camera was, and the more its speed changed before, the
    more the second one counts; it alone counts where the camera stood or the gap is long.

    The pose is where the camera must have got to. Its rotation is the one that images of the gap showed,
    where there are any. Otherwise, and so does the way, it changes evenly from that before the gap to that of
    the submap. Where neither images nor the speed tell anything, the camera goes on as it did.

    Args:
        motion: Of the camera so far.
        start: The new submap. It alone tells the scale: before it, the camera may have stood still.
        grown: The same with the earlier frames it was extended by.
        last_ns: Time of the newest keyframe of the map, None where there is none.
        depth: Median depth of the scene before the gap, in the map's unit.
        turned: How the camera turned since its last pose, see ``VisualGyroscope``.

    Returns:
        The pose of the first camera of ``grown``, the scale, and how far off they may be: what the weighted
        mean leaves of the scale's, and of pose what ``bridge_variances`` tells. Nothing is known of it where
        neither the motion told the scale nor images the turn, or where the past is too short.
    """
    at_ns = grown.keyframes[0].t_source_ns
    T_world_guess = motion.predict(at_ns)
    if T_world_guess is None or last_ns is None:
        return Bridge(np.eye(4), 1.0, None)
    first, last = start.keyframes[0], start.keyframes[-1]
    way = float(np.linalg.norm(last.T_world_cam[:3, 3] - first.T_world_cam[:3, 3]))
    elapsed_s = (last.t_source_ns - first.t_source_ns) * 1e-9
    since_s = (first.t_source_ns - last_ns) * 1e-9
    speed, speed_sigma = motion.speed_at(first.t_source_ns)
    gone = speed * elapsed_s
    turned = [then for then in turned if then[0] <= at_ns]
    # Of a source that gives two images one time, the second tells no speed.
    later = [k for k in grown.keyframes if k.t_source_ns > at_ns]
    scale, weight = depth, _DEPTH_SIGMA**-2
    if (
        since_s < _MAX_BRIDGE_S
        and gone > _LEAST_WAY * depth
        and depth / _MOST_FARTHER < gone / max(way, 1e-300) < _MOST_FARTHER * depth
    ):
        error = _SPEED_ERROR_DEPTHS_S * depth / speed
        weights = weight, 1.0 / (_SPEED_SIGMA**2 + error**2 + speed_sigma**2)
        scale = float(np.exp(np.average(np.log((depth, gone / way)), weights=weights)))
        weight = sum(weights)
    elif not later or not turned or turned[-1][0] != at_ns:
        return Bridge(T_world_guess, depth, None)
    soon = ([k for k in later if k.t_source_ns - at_ns <= _LATER_NS] or later[:1])[-1]
    T_later, later_s = soon.T_world_cam.copy(), (soon.t_source_ns - at_ns) * 1e-9
    T_later[:3, 3] *= scale
    T_world_first = motion.bridge(at_ns, T_later, later_s, turned)
    if T_world_first is None:
        return Bridge(T_world_guess, scale, None)
    variances = motion.bridge_variances(at_ns, later_s)
    if variances is None:
        return Bridge(T_world_first, scale, None)
    # The unit tells how fast the camera goes after the gap, and so a part of how far it got.
    T_later[:3, 3] = 0.0
    T_world_short = motion.bridge(at_ns, T_later, later_s, turned)
    assert T_world_short is not None
    by_scale = np.zeros(7)
    by_scale[3:6] = T_world_first[:3, :3].T @ (T_world_first[:3, 3] - T_world_short[:3, 3])
    by_scale[6] = 1.0
    covariance = np.diag(np.repeat((*variances, 0.0), (3, 3, 1)))
    return Bridge(T_world_first, scale, covariance + np.outer(by_scale, by_scale) / weight)
