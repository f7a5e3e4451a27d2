"""Finds and uses landmarks of old keyframes again when the camera comes back to where it has been.

Otherwise every return would make new landmarks where there are some already. Where the camera should see a
keyframe of long ago, that keyframe's landmarks are looked for: first by following them from its image, then
by aligning its patches, warped by pose and depth. What was found must agree with the relative pose of the two
images. It need not agree with the landmark's old position: seen under small angles in its time, a landmark
may be far off in depth, which shows from another place only. So it is triangulated anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.codec import KLT_WINDOW_PX
from semcast.common.geometry import angles_between_deg, invert_transform, transform_points
from semcast.server.geometry.epipolar import fundamental_matrix, sampson_px
from semcast.server.geometry.klt import TrackedPoints, track_points
from semcast.server.geometry.patch_alignment import Templates, affine_warps, align_patches, seen_alike
from semcast.server.geometry.pnp import reprojection_residual
from semcast.server.geometry.projection import MIN_DEPTH_MAP, depths_in
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import GATE_SIGMAS, NoiseModel
from semcast.server.mapping.keyframe_images import ImagedMap, SeenFrom
from semcast.server.mapping.new_landmarks import MAX_ERROR_SIGMA
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Standard deviation of positions that were found from an image of long ago.
_OLD_SIGMA_PX = 1.0
#: The newest keyframes, which are never a revisit: an adjustment has most of them in its window.
NUM_RECENT = 12
#: Old keyframes nearest to the camera whose landmarks are projected, at most.
_NUM_NEAREST = 6
#: How far away they may be: turn in half fields of view and distance in depths of the scene, added.
_MAX_APART = 2.0
#: How many of those keyframes are looked for in the image, one after the other.
_NUM_TRIED = 2
#: Landmarks of a keyframe that should be in sight for it to be looked at.
_MIN_EXPECTED = 30
#: Found landmarks that must agree with the relative pose.
_MIN_ON_LINES = 15
#: The same as a share of those found.
_MIN_ON_LINES_SHARE = 0.6
#: How alike the patches of a landmark must be, as their correlation.
_MIN_CORRELATION = 0.75
#: How far from its expected place an old landmark is followed: it is not exactly where the map has it.
_REACH_PX = 40.0
#: How far aligning its patch may then still move it.
_MAX_MOVE_PX = 3.0
#: Pyramid levels that reach so far.
_KLT_LEVELS = 2
#: A landmark is looked for no nearer to the border: its window is whole.
_MARGIN_PX = KLT_WINDOW_PX // 2
#: Keyframes before and after the old one that help to triangulate.
_NEIGHBOURS = 6
#: Rays must be further apart than this to tell a depth.
_MIN_PARALLAX_DEG = 1.0
#: A depth that changes by more than this factor (as a logarithm) is that of another point along the line.
_MAX_LOG_DEPTH = 0.7
#: Share of the found landmarks that must agree with one place each: of wrong ones some do by chance.
_MIN_PLACED_SHARE = 0.25


@dataclass(frozen=True)
class Revisit:
    """Landmarks of an old keyframe found in the newest image.

    Attributes:
        keyframe_id: The old keyframe.
        ids: ``(N,)`` landmarks, ascending.
        points: ``(N,)`` where they were found, ``ok`` where that agrees with the pose.
    """

    keyframe_id: int
    ids: Ids
    points: TrackedPoints


@dataclass(frozen=True)
class _Expected:
    """Landmarks of a keyframe that should be in sight."""

    keyframe: Keyframe
    image: SeenFrom
    rows: NDArray[np.intp]
    xy: Array
    warps: Array


def old_sigma_px(noise: NoiseModel) -> float:
    """Standard deviation in pixels of where a landmark of long ago is found again."""
    return max(_OLD_SIGMA_PX, noise.sigma0_px)


def find_revisit(
    mapped: ImagedMap, tracked_ids: Ids, sight: Sight, T_world_cam: Array, *, gate_px: float
) -> Revisit | None:
    """Look for landmarks of an old keyframe that should be in sight.

    Args:
        mapped: Keyframes, their images and landmarks.
        tracked_ids: Tracks that are alive: they need not be found.
        sight: The newest image.
        T_world_cam: Its pose.
        gate_px: Distance from the epipolar line up to which a point agrees with the pose.

    Returns:
        The keyframe of which most should be in sight and enough is, None where there is none.
    """
    T_cam_world = invert_transform(T_world_cam)
    candidates = [
        _expected(mapped, keyframe, image, tracked_ids, sight, T_cam_world)
        for keyframe, image in _nearest(mapped, T_world_cam)
    ]
    candidates = [c for c in candidates if len(c.rows) >= _MIN_EXPECTED]
    candidates.sort(key=lambda c: -len(c.rows))
    for candidate in candidates[:_NUM_TRIED]:
        found = _look(mapped.camera, candidate, sight, T_world_cam, gate_px)
        if found is not None:
            return found
    return None


def _nearest(mapped: ImagedMap, T_world_cam: Array) -> list[tuple[Keyframe, SeenFrom]]:
    """Old keyframes that looked at about the same from about there."""
    world = mapped.world
    mine = world.keyframes_of(mapped.submap)
    by_id = {k.frame_id: k for k in mine[:-NUM_RECENT]}
    known = [(by_id[image.frame_id], image) for image in mapped.images if image.frame_id in by_id]
    if not known:
        return []
    T_world_old = np.stack([keyframe.T_world_cam for keyframe, _ in known])
    way = np.linalg.norm(T_world_old[:, :3, 3] - T_world_cam[:3, 3], axis=1) / median_depth(world, mine[-1])
    turn = np.arccos(np.clip(T_world_old[:, :3, 2] @ T_world_cam[:3, 2], -1.0, 1.0))
    apart = turn / mapped.camera.half_diagonal_rad + way
    nearest = np.argsort(apart, kind="stable")[:_NUM_NEAREST]
    return [known[k] for k in nearest.tolist() if apart[k] < _MAX_APART]


def _expected(
    mapped: ImagedMap,
    keyframe: Keyframe,
    image: SeenFrom,
    tracked_ids: Ids,
    sight: Sight,
    T_cam_world: Array,
) -> _Expected:
    camera, world = mapped.camera, mapped.world
    row = world.landmarks.rows(keyframe.ids)
    rows = np.flatnonzero((row >= 0) & ~np.isin(keyframe.ids, tracked_ids, assume_unique=True))
    depth = depths_in(invert_transform(keyframe.T_world_cam), world.landmarks.xyz[row[rows]])
    rows, depth = rows[depth > MIN_DEPTH_MAP], depth[depth > MIN_DEPTH_MAP]
    warps, depth_now = affine_warps(camera, T_cam_world @ keyframe.T_world_cam, keyframe.xy[rows], depth)
    good = seen_alike(warps, depth_now)
    points_cam = transform_points(T_cam_world, world.landmarks.xyz[row[rows]])
    xy = camera.project(np.where(good[:, None], points_cam, (0.0, 0.0, 1.0)))
    good &= sight.shows(xy, _MARGIN_PX)
    return _Expected(keyframe, image, rows[good], xy[good], warps[good])


def _look(
    camera: Intrinsics, expected: _Expected, sight: Sight, T_world_cam: Array, gate_px: float
) -> Revisit | None:
    """Find a keyframe's landmarks where they agree with the relative pose."""
    keyframe, rows = expected.keyframe, expected.rows
    xy0 = keyframe.xy[rows]
    points = track_points(expected.image.grey, sight.grey, xy0, expected.xy, max_level=_KLT_LEVELS)
    near = points.ok & (np.linalg.norm(points.xy - expected.xy, axis=1) < _REACH_PX)
    tried = np.flatnonzero(near)
    aligned = align_patches(
        Templates.cut(expected.image.grey, xy0[tried]), sight.grey, points.xy[tried], expected.warps[tried]
    )
    moved = np.linalg.norm(aligned.xy - points.xy[tried], axis=1)
    fits = (aligned.correlation > _MIN_CORRELATION) & (moved < _MAX_MOVE_PX)
    tried, xy = tried[fits], aligned.xy[fits]
    if len(tried) < _MIN_ON_LINES:
        return None
    F = fundamental_matrix(camera, invert_transform(T_world_cam) @ keyframe.T_world_cam)
    agrees = np.abs(sampson_px(F, xy0[tried], xy)) < gate_px
    if int(agrees.sum()) < max(_MIN_ON_LINES, _MIN_ON_LINES_SHARE * len(tried)):
        return None
    all_xy, ok = points.xy.copy(), np.zeros(len(rows), bool)
    all_xy[tried], ok[tried] = xy, agrees
    return Revisit(keyframe.frame_id, keyframe.ids[rows], replace(points, xy=all_xy, ok=ok))


def off_lines_px(camera: Intrinsics, world: WorldMap, found: Revisit, T_world_cam: Array) -> Array:
    """Distances ``(N,)`` of found points to their epipolar lines if the newest frame is there (Eq. 14).

    Args:
        camera: Pinhole.
        world: The map.
        found: Landmarks of an old keyframe; those that are ``ok`` count.
        T_world_cam: ``(4, 4)``, where the newest frame is taken to be.
    """
    ids, xy = found.ids[found.points.ok], found.points.xy[found.points.ok]
    keyframe = next(k for k in world.keyframes if k.frame_id == found.keyframe_id)
    F = fundamental_matrix(camera, invert_transform(T_world_cam) @ keyframe.T_world_cam)
    return np.abs(sampson_px(F, keyframe.xy[np.searchsorted(keyframe.ids, ids)], xy))


def tells_depth(camera: Intrinsics, keyframes: Sequence[Keyframe], ids: Ids) -> NDArray[np.bool_]:
    """Which landmarks ``ids (N,)``, ascending, keyframes saw under angles that tell how far away they are."""
    seen = gather_observations(keyframes, ids)
    R_world_cam = np.stack([k.T_world_cam[:3, :3] for k in keyframes])
    rays = np.einsum("nij,nj->ni", R_world_cam[seen.view], camera.unproject(seen.xy))
    _, first = np.unique(seen.point, return_index=True)
    number = np.searchsorted(seen.point[first], seen.point)
    widest_deg = np.zeros(len(ids))
    np.maximum.at(widest_deg, seen.point, angles_between_deg(rays, rays[first[number]]))
    return widest_deg > _MIN_PARALLAX_DEG


def place_anew(
    camera: Intrinsics,
    world: WorldMap,
    found: Revisit,
    T_world_cam: Array,
    noise: NoiseModel,
    sigma_px: float,
) -> TrackedPoints:
    """Triangulate found landmarks from the keyframes around the old one and from the newest frame.

    Args:
        camera: Pinhole.
        world: The map; landmarks move.
        found: Landmarks and where the newest frame sees them.
        T_world_cam: Pose of the newest frame.
        noise: Of the observations of keyframes.
        sigma_px: Of those of the newest frame.

    Returns:
        The points found, ``ok`` where all rays agree, that of the newest frame for itself too. Where rays are
        too close to each other to tell the depth, the landmark stays, and has to be seen where it is.
    """
    submap = world.submap_of[found.keyframe_id]
    mine = world.keyframes_of(submap)
    at = next(row for row, k in enumerate(mine) if k.frame_id == found.keyframe_id)
    views = mine[max(0, at - _NEIGHBOURS) : at + _NEIGHBOURS + 1]
    ids, xy = found.ids[found.points.ok], found.points.xy[found.points.ok]
    count = len(ids)
    view, point, xy_then, confidence, _ = gather_observations(views, ids)
    T_cam_world = invert_transform(T_world_cam)
    placed = triangulate(
        camera,
        np.concatenate([invert_transform(np.stack([k.T_world_cam for k in views])), T_cam_world[None]]),
        np.concatenate([view, np.full(count, len(views), np.intp)]),
        np.concatenate([point, np.arange(count, dtype=np.intp)]),
        np.concatenate([xy_then, xy]),
        np.concatenate([noise.sigma_px(confidence), np.full(count, sigma_px)]),
        count,
    )
    before = world.landmarks.xyz_of(ids)
    told = placed.parallax_deg > _MIN_PARALLAX_DEG
    xyz = np.where(told[:, None], placed.xyz, before)
    residual, in_front = reprojection_residual(camera, T_cam_world, xyz, xy)
    good = in_front & (np.linalg.norm(residual, axis=1) < GATE_SIGMAS * sigma_px)
    at_old = world.poses[found.keyframe_id][:3, 3]
    depth, depth_before = (np.linalg.norm(x - at_old, axis=1) for x in (xyz, before))
    change = np.abs(np.log(np.maximum(depth, 1e-9) / np.maximum(depth_before, 1e-9)))
    sound = placed.in_front & (placed.error_sigma < MAX_ERROR_SIGMA) & (change < _MAX_LOG_DEPTH)
    good &= ~told | sound
    if good.sum() < _MIN_PLACED_SHARE * count:
        good[:] = False
    world.move_landmarks(ids[good & told], xyz[good & told])
    ok = found.points.ok.copy()
    ok[ok] = good
    return replace(found.points, ok=ok)
