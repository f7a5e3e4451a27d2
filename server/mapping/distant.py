"""Tracks that are no landmarks, as points of one adjustment.

Little parallax says little about a depth, but the direction of a distant point holds the rotation of the
keyframes that see it, and with it the direction of their way. Landmarks alone leave that to what is near:
a window whose first pose alone is held then drifts, most where the camera moves straight ahead. The points
are placed for one adjustment and forgotten after it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.mapper import MAX_DEPTH_RATIO, gather_observations, median_depth
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Points of one adjustment at most.
_MAX_POINTS = 300
#: Root mean square distance to the observations at most, in standard deviations: poses are not adjusted yet.
_MAX_ERROR_SIGMA = 3.0


@dataclass(frozen=True)
class DistantPoints:
    """Points for tracks without a landmark.

    Attributes:
        ids: ``(N,)`` tracks, ascending.
        xyz: ``(N, 3)`` world frame.
    """

    ids: Ids
    xyz: Array


def distant_points(
    world: WorldMap, camera: Intrinsics, noise: NoiseModel, views: list[Keyframe], ids: Ids
) -> DistantPoints:
    """Place tracks that at least two views see; those without parallax as far away as a landmark may be.

    Args:
        world: The map.
        camera: Pinhole.
        noise: Gives each observation its sigma.
        views: Keyframes of one submap, in order of time.
        ids: ``(M,)`` tracks without a landmark, ascending.

    Returns:
        Those that agree with where the views saw them.
    """
    nothing = DistantPoints(np.zeros(0, np.int64), np.zeros((0, 3)))
    reach = MAX_DEPTH_RATIO * median_depth(world, views[-1])
    _, point, _, _ = gather_observations(views, ids)
    num_views = np.bincount(point, minlength=len(ids))
    chosen = np.argsort(-num_views, kind="stable")[:_MAX_POINTS]
    ids = ids[np.sort(chosen[num_views[chosen] >= 2])]
    if len(ids) == 0 or not np.isfinite(reach):
        return nothing
    view, point, xy, confidence = gather_observations(views, ids)
    T_world_cam = np.stack([k.T_world_cam for k in views])
    T_cam_world = invert_transform(T_world_cam)
    sigma_px = noise.sigma_px(confidence)
    placed = triangulate(camera, T_cam_world, view, point, xy, sigma_px, len(ids))
    newest = np.zeros(len(ids), np.intp)
    newest[point] = np.arange(len(point))  # observations are in order of time: the last one stays
    T = T_world_cam[view[newest]]
    depth = np.einsum("ni,ni->n", placed.xyz - T[:, :3, 3], T[:, :3, 2])
    ray = reach * camera.unproject(xy[newest])
    at_reach = np.einsum("nij,nj->ni", T[:, :3, :3], ray) + T[:, :3, 3]
    xyz = np.where((placed.in_front & (depth < reach))[:, None], placed.xyz, at_reach)
    seen_from = T_cam_world[view]
    points_cam = np.einsum("mij,mj->mi", seen_from[:, :3, :3], xyz[point]) + seen_from[:, :3, 3]
    square = ((camera.project(points_cam) - xy) ** 2).sum(axis=1) / sigma_px**2
    square = np.where(points_cam[:, 2] > 0, square, np.inf)
    error_sigma = np.sqrt(np.bincount(point, square) / np.bincount(point))
    good = error_sigma < _MAX_ERROR_SIGMA
    return DistantPoints(ids[good], xyz[good])
