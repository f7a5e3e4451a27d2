"""Pose of each frame from the landmarks it sees, with a motion prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.pnp import PoseEstimate, refine_pose, search_pose
from semcast.server.geometry.projection import MIN_DEPTH_MAP
from semcast.server.geometry.square_distance import square_distances
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.rays import rays_of
from semcast.server.mapping.sight import Seen
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Agreeing landmarks a pose needs.
MIN_INLIERS = 15
#: With fewer inliers than this share, the start was poor: search without it.
_MIN_INLIER_SHARE = 0.5
#: Share of the landmarks in sight that must agree with a pose, when the frame before had one.
MIN_BELIEVED_SHARE = 0.25
#: So many, and that share, must agree when frames are missing since then and the pose was searched for: a row
#: of equal houses fits itself one house on as well, with all that is seen of it.
_BELIEVED_AFTER_GAP = (30, 0.5)
#: So many rays, and that share of them, must agree to steady a pose, and that share of its landmarks still.
_STEADY, _MIN_KEPT_SHARE = (10, 0.5), 0.8
#: Rays that steady a pose may raise the cost of its landmarks, errors cut off at so many standard deviations,
#: by so much in all, as noise does with six unknowns, and so much for each. What moves by itself has rays as
#: well, and takes 0.2 to 8 for each, where at rest it is up to 0.18.
_MOST_TAKEN, _MOST_TAKEN_EACH, _CUT_SIGMAS = 12.0, 0.2, 3.0
#: Where fewer landmarks than this are in sight, so many rays, and that share of them, carry the pose on with
#: the few landmarks that are left: without any, turning and moving are told apart by nothing.
_RUN_OUT, _CARRY, _MIN_LEFT = 30, (60, 0.6), 4
#: The gate of a ray is so many times as wide at most for what the keyframe's observation is in doubt.
_MOST_WIDER = 3.0


class Believing(TypedDict, total=False):
    """When a pose is believed, arguments of ``track_pose``."""

    min_share: float
    may_carry: bool
    is_after_gap: bool


@dataclass(frozen=True)
class TrackedPose:
    """The pose of one frame and what it rests on.

    Attributes:
        T_world_cam: ``(4, 4)``.
        covariance: ``(6, 6)`` in the camera's frame, rotation before translation, or None.
        ids: ``(N,)`` landmarks that were looked at.
        inliers: ``(N,)`` bool, those that agree.
        residual_px: ``(N,)`` reprojection errors, as if they were known alike in all directions.
    """

    T_world_cam: Array
    covariance: Array | None
    ids: Ids
    inliers: NDArray[np.bool_]
    residual_px: Array

    @property
    def num_inliers(self) -> int:
        """Landmarks that agree."""
        return int(self.inliers.sum())

    @property
    def median_error_px(self) -> float:
        """Median reprojection error of those that agree."""
        return float(np.median(self.residual_px[self.inliers])) if self.inliers.any() else float("inf")

    def with_unit(self, scale: float) -> "TrackedPose":
        """Return the same with its covariance in a map whose lengths are so many times as large."""
        unit = np.repeat((1.0, scale), 3)
        covariance = None if self.covariance is None else self.covariance * np.outer(unit, unit)
        return replace(self, covariance=covariance)


def expected_positions(
    camera: Intrinsics,
    world: WorldMap,
    tracks: TrackTable,
    T_world_cam: Array,
    T_world_seen: Sequence[Array | None],
) -> Array:
    """Where tracks are expected in a frame with a given pose, ``(N, 2)``.

    Landmarks are projected. Other tracks are taken to be as far as the landmark that is next to them in the
    image they were last seen in; where that is not known they go on as they moved.

    Args:
        camera: Pinhole.
        world: The map.
        tracks: As the frames before left them.
        T_world_cam: ``(4, 4)`` expected pose.
        T_world_seen: Poses of the frames before, newest first, as far back as a track may have been out of
            sight; None where a frame has none.
    """
    ahead = tracks.xy + tracks.velocity * (tracks.missed + 1)[:, None]
    row = world.landmarks.rows(tracks.ids)
    known = row >= 0
    if int(known.sum()) < 5:
        return ahead
    T_cam_world = invert_transform(T_world_cam)
    expected = ahead.copy()
    around = world.landmarks.xyz[row[known]]
    expected[known] = _project(camera, T_cam_world, around, ahead[known])
    for missed, T_world_then in enumerate(T_world_seen):
        unknown = np.flatnonzero(~known & (tracks.missed == missed))
        if T_world_then is None or len(unknown) == 0:
            continue
        T_then_world = invert_transform(T_world_then)
        seen = transform_points(T_then_world, around)
        seen = seen[seen[:, 2] > MIN_DEPTH_MAP]
        if len(seen) == 0:
            continue
        depth = seen[square_distances(tracks.xy[unknown], camera.project(seen)).argmin(axis=1), 2]
        rays = camera.unproject(tracks.xy[unknown]) * depth[:, None]
        points = transform_points(T_world_then, rays)
        expected[unknown] = _project(camera, T_cam_world, points, ahead[unknown])
    return expected


def _project(camera: Intrinsics, T_cam_world: Array, xyz: Array, otherwise: Array) -> Array:
    points_cam = transform_points(T_cam_world, xyz)
    projected = camera.project(points_cam)
    return np.where(np.isfinite(projected).all(axis=1, keepdims=True), projected, otherwise)


def track_pose(
    camera: Intrinsics,
    world: WorldMap,
    noise: NoiseModel,
    seen: Seen,
    T_world_guess: Array | None,
    *,
    submap: int,
    seed: int,
    min_inliers: int = MIN_INLIERS,
    min_share: float = MIN_BELIEVED_SHARE,
    may_carry: bool = False,
    is_after_gap: bool = False,
) -> TrackedPose | None:
    """Pose from the landmarks among the tracks of a frame, steadied by the other tracks.

    Args:
        camera: Pinhole.
        world: The map.
        noise: Gives each observation its sigma.
        seen: Tracks in sight.
        T_world_guess: Expected pose, or None to search for it.
        submap: Part of the map the camera is in.
        seed: Of the search.
        min_inliers: Agreeing landmarks needed.
        min_share: And their share of all that are in sight: fewer are a chance find.
        may_carry: Where landmarks have all but run out, let many other tracks carry the guess on with fewer
            than ``min_inliers``.
        is_after_gap: Frames are missing before this one: what contradicts the guess must have more behind it.

    Returns:
        The pose, or None when too few landmarks agree with any.
    """
    known = world.landmarks.rows(seen.ids) >= 0
    marks, others = seen[known], seen[~known]
    points = world.landmarks.xyz[world.landmarks.rows(marks.ids)]
    sigma, gate = noise.sigma_px(marks.confidence), noise.threshold_px(marks.confidence)
    best: PoseEstimate | None = None
    if T_world_guess is not None and len(points) >= min_inliers:
        best = refine_pose(
            camera, invert_transform(T_world_guess), points, marks.xy, sigma, gate, edge=marks.edge
        )
    if best is None or best.num_inliers < max(min_inliers, _MIN_INLIER_SHARE * len(points)):
        count, share = _BELIEVED_AFTER_GAP if is_after_gap else (0, 0.0)
        least = max(min_inliers, count, math.ceil(share * len(points)))
        how = {"seed": seed, "min_inliers": least}
        searched = search_pose(camera, points, marks.xy, sigma, gate, edge=marks.edge, **how)
        if searched is not None and (best is None or searched.num_inliers > best.num_inliers):
            best = searched
    enough = max(min_inliers, min_share * len(points))
    if best is not None and (best.num_inliers < enough or not np.isfinite(best.T_cam_world).all()):
        best = None
    if best is None and may_carry and T_world_guess is not None and len(points) < _RUN_OUT:
        left = max(_MIN_LEFT, min_share * len(points))
        best = _steadied(camera, world, noise, marks, others, T_world_guess, submap, _CARRY, left)
    elif best is not None and len(others):
        T, kept = invert_transform(best.T_cam_world), max(enough, _MIN_KEPT_SHARE * best.num_inliers)
        steadied = _steadied(camera, world, noise, marks, others, T, submap, _STEADY, kept)
        most_taken = _MOST_TAKEN + _MOST_TAKEN_EACH * len(marks)
        if steadied is not None and _cost(steadied, sigma) < _cost(best, sigma) + most_taken:
            best = steadied
    if best is None:
        return None
    T_world_cam = invert_transform(best.T_cam_world)
    return TrackedPose(T_world_cam, best.covariance, marks.ids, best.inliers, best.residual_px)


def _cost(pose: PoseEstimate, sigma_px: Array) -> float:
    """Sum of the squared errors of landmarks in standard deviations, each cut off."""
    return float((np.minimum(pose.residual_px / sigma_px, _CUT_SIGMAS) ** 2).sum())


def _steadied(
    camera: Intrinsics,
    world: WorldMap,
    noise: NoiseModel,
    marks: Seen,
    others: Seen,
    T_world_cam: Array,
    submap: int,
    needed: tuple[int, float],
    min_inliers: float,
) -> PoseEstimate | None:
    """Refine a pose with what the tracks without a landmark say too.

    Args:
        camera: Pinhole.
        world: The map.
        noise: Gives each observation its sigma.
        marks: Tracks that have a landmark.
        others: Those that have none.
        T_world_cam: Where to begin.
        submap: Part of the map the camera is in.
        needed: Rays that must agree, and their share.
        min_inliers: Landmarks that must agree.

    Returns:
        The pose with the landmarks it agrees with; None where too few agree.
    """
    rays = rays_of(camera, world, noise, others.ids, T_world_cam, submap)
    if rays is None or len(rays.row) < needed[0]:
        return None
    count, with_ray = len(marks), others[rays.row]
    points = np.concatenate([world.landmarks.xyz[world.landmarks.rows(marks.ids)], rays.xyz])
    observed = np.concatenate([marks.xy, with_ray.xy])
    confidence = np.concatenate([marks.confidence, with_ray.confidence])
    sigma, gate = noise.sigma_px(confidence), noise.threshold_px(confidence)
    # Both ends of a ray are observed, the keyframe's and this one.
    wider = np.hypot(sigma[count:], rays.sigma_px) / sigma[count:]
    sigma[count:] *= wider
    gate[count:] *= np.minimum(wider, _MOST_WIDER)
    spread = np.concatenate([np.zeros((count, 2)), rays.spread_px])
    edge = np.concatenate([marks.edge, with_ray.edge])
    start = invert_transform(T_world_cam)
    pose = refine_pose(
        camera, start, points, observed, sigma, gate, iterations=6, spread_px=spread, edge=edge
    )
    agreeing, rays_agreeing = pose.inliers[:count], pose.inliers[count:]
    if agreeing.sum() < min_inliers or rays_agreeing.sum() < max(needed[0], needed[1] * len(rays.row)):
        return None
    return replace(pose, inliers=agreeing, residual_px=pose.residual_px[:count])
