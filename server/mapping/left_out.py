"""Landmarks an adjustment had no room for follow the keyframes it moved.

An adjustment takes observations up to a number. A landmark it leaves out was placed by poses it has
corrected: kept where it was it would pull every frame until the next keyframe back to them.
"""

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.bundle_problem import BundleResult
from semcast.server.mapping.mapper import MAX_ERROR_SIGMA, gather_observations
from semcast.server.mapping.world_map import WorldMap

#: Keyframes whose observations place a point, the newest ones: as many as a usual window has.
_NUM_KEYFRAMES = 20


def place_left_out(world: WorldMap, camera: Intrinsics, noise: NoiseModel, result: BundleResult) -> int:
    """Triangulate again what the keyframes of an adjustment see and the adjustment did not hold.

    Args:
        world: The map, with the adjustment applied.
        camera: Pinhole.
        noise: Gives each observation its sigma.
        result: The adjustment.

    Returns:
        Number of landmarks that were placed anew.
    """
    problem = result.problem
    last_id = int(problem.keyframe_ids[-1])
    if not result.ok or last_id not in world.submap_of or len(world.landmarks) == 0:
        return 0
    submap = world.submap_of[last_id]
    moved = set(problem.keyframe_ids[~problem.fixed].tolist())
    views = [k for k in world.keyframes_of(submap) if k.frame_id <= last_id][-_NUM_KEYFRAMES:]
    seen = [k.ids for k in views if k.frame_id in moved]
    if not seen:
        return 0
    ids = np.setdiff1d(np.concatenate(seen), problem.landmark_ids)
    row = world.landmarks.rows(ids)
    # What came after the adjustment was asked for has moved with its last keyframe.
    there = (row >= 0) & (world.landmarks.born[row] <= last_id) & (world.landmarks.submap[row] == submap)
    ids = ids[there]
    view, point, xy, confidence, edge = gather_observations(views, ids)
    count = np.bincount(point, minlength=len(ids))
    if not (count >= 2).any():
        return 0
    T_cam_world = invert_transform(np.stack([k.T_world_cam for k in views]))
    sigma_px = noise.sigma_px(confidence)
    placed = triangulate(camera, T_cam_world, view, point, xy, sigma_px, len(ids), refinements=1, edge=edge)
    good = (count >= 2) & placed.in_front & (placed.error_sigma < MAX_ERROR_SIGMA)
    world.move_landmarks(ids[good], placed.xyz[good])
    return int(good.sum())
