"""Tracks without a depth, as rays from the keyframe that saw them: they hold the camera's rotation.

While a camera turns, most of what it sees is new, and the few landmarks left lie on one side of the image,
where turning and moving look alike. The new tracks are many and everywhere. How far their points are is known
roughly, as far as others: that much uncertainty moves a projection only along one line, and hardly at all
while the camera is near the keyframe (inverse depth with its uncertainty: Civera, Davison and Montiel 2008).
Something large that moves by itself has such tracks too, many, and for long: keyframes tell them by that no
point at rest explains where they were seen. Where keyframes have turned wrongly themselves, that is said of
the far view as well.
"""

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.refuted import on_something_large
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.track_ids import rows_among
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Standard deviation of an inverse depth, as share of that of the usual depth.
_INVERSE_DEPTH_SHARE = 0.6
#: Keyframes whose tracks are looked at.
_NUM_KEYFRAMES = 12
#: A point must lie at least this share of its usual depth in front of the camera.
_MIN_DEPTH_SHARE = 0.05


@dataclass(frozen=True)
class Rays:
    """Points at a usual depth for tracks without one.

    Attributes:
        row: ``(N,)`` which of the tracks asked for.
        xyz: ``(N, 3)`` world frame.
        spread_px: ``(N, 2)`` by how much a standard deviation of the inverse depth moves the projection,
            times the root of N: what is wrong with the usual depth is wrong for all of them, so together they
            say no more about the camera's way than one.
        sigma_px: ``(N,)`` standard deviation of the observation in the keyframe.
    """

    row: NDArray[np.intp]
    xyz: Array
    spread_px: Array
    sigma_px: Array


def rays_of(
    camera: Intrinsics,
    world: WorldMap,
    noise: NoiseModel,
    ids: Ids,
    T_world_cam: Array,
    submap: int,
    *,
    with_refuted: bool = False,
) -> Rays | None:
    """Rays of tracks from the newest keyframe that saw each.

    Args:
        camera: Pinhole.
        world: The map.
        noise: Of the observations in keyframes.
        ids: ``(M,)`` tracks.
        T_world_cam: Approximate pose of the camera.
        submap: Part of the map whose keyframes count.
        with_refuted: Take what that keyframe refuted too, where that is much.

    Returns:
        Those of the tracks that a keyframe saw, without those that it refuted unless they are asked for; None
        where there is none or no depth is known.
    """
    views = _newest(world, submap)
    depth = float("inf")
    T_cam_world = invert_transform(T_world_cam)
    xyz, spread_px, sigma_px = np.zeros((len(ids), 3)), np.zeros((len(ids), 2)), np.zeros(len(ids))
    found, refuted = np.zeros(len(ids), bool), np.zeros(len(ids), bool)
    for position, keyframe in enumerate(views):
        row = rows_among(ids, keyframe.ids)
        new = np.flatnonzero(~found & ~refuted & (row >= 0))
        # A few that are refuted have slipped. Many are something large, or the far view.
        if len(keyframe.refuted) and not (with_refuted and len(on_something_large(keyframe))):
            refuted[new] = np.isin(ids[new], keyframe.refuted)
            new = new[~refuted[new]]
        if len(new) == 0:
            continue
        own = _first_known_depth(world, views[position:])
        depth = own if np.isfinite(own) else depth
        if not np.isfinite(depth):
            break
        point = camera.unproject(keyframe.xy[row[new]]) * depth
        T_cam_keyframe = T_cam_world @ keyframe.T_world_cam
        x, y, z = transform_points(T_cam_keyframe, point).T
        front = z > _MIN_DEPTH_SHARE * depth
        z = np.where(front, z, 1.0)
        # The derivative of the projection by the inverse depth, times its standard deviation.
        t = _INVERSE_DEPTH_SHARE * T_cam_keyframe[:3, 3]
        spread_px[new] = np.column_stack(
            [camera.fx * (t[0] - x / z * t[2]) / z, camera.fy * (t[1] - y / z * t[2]) / z]
        )
        xyz[new] = transform_points(keyframe.T_world_cam, point)
        sigma_px[new] = noise.sigma_px(keyframe.confidence[row[new]])
        found[new[front]] = True
        if (found | refuted).all():
            break
    rows = np.flatnonzero(found)
    if len(rows) == 0:
        return None
    return Rays(rows, xyz[rows], np.sqrt(len(rows)) * spread_px[rows], sigma_px[rows])


def much_is_refuted(world: WorldMap, submap: int) -> bool:
    """Tell whether ``with_refuted`` can change what ``rays_of`` returns."""
    return any(len(on_something_large(keyframe)) for keyframe in _newest(world, submap))


def _newest(world: WorldMap, submap: int) -> list[Keyframe]:
    """Keyframes whose tracks become rays, newest first; the map may have a thousand."""
    mine = (k for k in reversed(world.keyframes) if k.submap == submap and len(k.ids))
    return list(islice(mine, _NUM_KEYFRAMES))


def _first_known_depth(world: WorldMap, views: list[Keyframe]) -> float:
    """Median depth of the landmarks of the first view that has some; infinite where none has."""
    return next((d for d in (median_depth(world, k) for k in views) if np.isfinite(d)), float("inf"))
