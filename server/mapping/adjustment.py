"""Brings the result of a bundle adjustment into the map, which may have grown since it was asked for."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult
from semcast.server.mapping.new_landmarks import MAX_ERROR_SIGMA
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

_NONE: Ids = np.zeros(0, np.int64)
#: Noise is judged by residuals that keep at least this share of its variance.
_MIN_LEFT = 0.1
#: The distance between keyframes tells a scale only above this share of the scene's depth.
_LEAST_WAY = 0.002
#: Keyframes whose observations place a landmark that was left out, the newest ones: as many as a usual window
#: has.
_NUM_KEYFRAMES = 20


def apply_result(world: WorldMap, result: BundleResult, noise: OnlineNoise) -> None:
    """Bring an adjustment into the map, which may have grown since it was submitted.

    Keyframes and landmarks that came later move rigidly with the last keyframe of the window. Frames that are
    no keyframes move with theirs, and take over what has become of the scale around it. Observations
    outside the gate are dropped, and landmarks left with fewer than two of them. The noise model is
    fitted again.
    """
    problem = result.problem
    if not result.ok:
        return
    last_id = int(problem.keyframe_ids[-1])
    if last_id not in world.poses:
        return
    T_correction = result.T_world_cam[-1] @ invert_transform(world.poses[last_id])
    submap = world.submap_of[last_id]
    for keyframe in world.keyframes:
        if keyframe.frame_id > last_id and keyframe.submap == submap:
            world.move_keyframe(keyframe.frame_id, T_correction @ keyframe.T_world_cam)
    marks = world.landmarks
    later = marks.ids[(marks.born > last_id) & (marks.submap == submap)]
    xyz = marks.xyz[marks.rows(later)]
    world.move_landmarks(later, transform_points(T_correction, xyz))
    for frame_id, T_world_cam, fixed in zip(
        problem.keyframe_ids.tolist(), result.T_world_cam, problem.fixed.tolist(), strict=True
    ):
        if not fixed:
            world.move_keyframe(frame_id, T_world_cam)
    world.rescale_frames(dict(zip(problem.keyframe_ids.tolist(), local_scales(result).tolist(), strict=True)))
    # A landmark that was given up and made again while the adjustment ran is one of those that came later.
    same = ~np.isin(problem.landmark_ids, later)
    world.move_landmarks(problem.landmark_ids[same], result.xyz[same])
    known = np.asarray(np.isfinite(result.residual_px).all(axis=1))
    error = result.whitened_px
    size = np.linalg.norm(np.nan_to_num(error), axis=1)
    left = _share_left(problem, known)
    telling = (
        known & (problem.view >= problem.num_anchors) & (size < 12.0 * problem.sigma_px) & (left > _MIN_LEFT)
    )
    as_noise = np.abs(error[telling]) / np.sqrt(left[telling, None])
    noise.add(np.repeat(problem.confidence[telling], 2), as_noise.ravel())
    drop_outliers(world, result, noise.model, spared=later)


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


def local_scales(result: BundleResult) -> Array:
    """By how much an adjustment has scaled the map around each keyframe, ``(K,)``.

    It is the factor on the distances to the keyframes before and after it. It is 1 if the keyframe is fixed,
    or if these distances are next to nothing, as of a camera that turns on the spot: how they change is
    chance. Depths of landmarks tell less, as they change with the motion of the camera itself, too.
    """
    problem = result.problem
    depth = float(
        np.median(depths_in(invert_transform(problem.T_world_cam)[problem.view], problem.xyz[problem.point]))
    )
    return np.where(problem.fixed, 1.0, scales_around(problem.T_world_cam, result.T_world_cam, depth))


def scales_around(T_world_before: Array, T_world_after: Array, depth: float) -> Array:
    """By how much the map was scaled around poses that were moved, ``(K,)``, see ``local_scales``.

    Args:
        T_world_before: ``(K, 4, 4)`` in order of time.
        T_world_after: The same, moved.
        depth: How far away the scene was: where distances are next to nothing against it, the factor is 1.
    """
    before, after = _ways(T_world_before), _ways(T_world_after)
    is_told = before > _LEAST_WAY * depth
    return np.where(is_told, after / np.where(is_told, before, 1.0), 1.0)


def _ways(T_world_cam: Array) -> Array:
    """Sum of the distances, ``(K,)``, from each of ``(K, 4, 4)`` poses to those before and after it."""
    ways = np.zeros(len(T_world_cam))
    steps = np.linalg.norm(np.diff(T_world_cam[:, :3, 3], axis=0), axis=1)
    ways[:-1] += steps
    ways[1:] += steps
    return ways


def drop_outliers(world: WorldMap, result: BundleResult, noise: NoiseModel, spared: Ids = _NONE) -> None:
    """Drop observations outside the gate, and landmarks left with fewer than two of them.

    Args:
        world: The map, with the adjustment applied.
        result: The adjustment.
        noise: Gives each observation its gate.
        spared: Landmarks that are elsewhere by now: where they were says nothing against them.
    """
    problem = result.problem
    size = np.linalg.norm(np.nan_to_num(result.whitened_px, nan=np.inf), axis=1)
    bad = size > 1.3 * noise.threshold_px(problem.confidence)
    _drop(world, problem, bad & ~np.isin(problem.landmark_ids, spared)[problem.point])


def _share_left(problem: BundleProblem, known: NDArray[np.bool_]) -> Array:
    """Share of each observation's noise variance that is left in its residual, ``(M,)``, perhaps below 0.

    Unknowns were fitted to the observations, which takes their leverage (the diagonal of the hat matrix, here
    landmark by landmark and view by view) off the variance. The three unknowns of a landmark and the six of a
    view are shared out among their observations by weight: what has more weight is fitted more closely.
    Without that, weights would make the very residuals that then ask for stronger weights.
    """
    weight = np.where(known, problem.sigma_px**-2.0, 0.0)
    of_point = np.bincount(problem.point, weight, minlength=len(problem.xyz))[problem.point]
    of_view = np.bincount(problem.view, weight, minlength=len(problem.fixed))[problem.view]
    leverage = 1.5 * weight / np.maximum(of_point, 1e-12)
    leverage += np.where(problem.fixed[problem.view], 0.0, 3.0 * weight / np.maximum(of_view, 1e-12))
    return np.asarray(1.0 - leverage)


def _drop(world: WorldMap, problem: BundleProblem, bad: NDArray[np.bool_]) -> None:
    """Forget observations, and landmarks that are left with too few."""
    for k, frame_id in enumerate(problem.keyframe_ids.tolist()):
        rows = np.flatnonzero(bad & (problem.view == k))
        keyframe = world.keyframe(frame_id) if len(rows) else None
        if keyframe is not None:
            keyframe.drop_observations(np.isin(keyframe.ids, problem.landmark_ids[problem.point[rows]]))
    left = np.bincount(problem.point[~bad], minlength=len(problem.xyz))
    # Keyframes outside the problem saw those of long ago too: one new frame does not refute a landmark.
    of_long_ago = np.isin(np.arange(len(left)), problem.point[problem.view < problem.num_anchors])
    row = world.landmarks.rows(problem.landmark_ids[(left < 2) & ~of_long_ago])
    mask = np.zeros(len(world.landmarks), bool)
    mask[row[row >= 0]] = True
    world.remove_landmarks(mask)
