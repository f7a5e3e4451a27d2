"""Pose of each frame from the landmarks it sees, with a motion prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.pnp import PoseEstimate, refine_pose, search_pose
from semcast.server.geometry.projection import MIN_DEPTH_MAP
from semcast.server.geometry.ray_observations import RayObservations
from semcast.server.geometry.square_distance import square_distances
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.rays import much_is_refuted, rays_of
from semcast.server.mapping.sight import Seen
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Agreeing landmarks a pose needs.
MIN_INLIERS = 15
#: When a smaller share of the landmarks agrees with the refined guess, the guess was poor: search without it.
_MIN_INLIER_SHARE = 0.5
#: Share of the landmarks in sight that must agree with a pose, when the frame before had one.
MIN_BELIEVED_SHARE = 0.25
#: Number of landmarks, and share of those in sight, that must agree with a pose that was searched for after
#: missing frames: a row of equal houses fits itself one house on as well, with all that is seen of it.
_BELIEVED_AFTER_GAP = (30, 0.5)
#: Number and share of rays that must agree for them to steady a pose.
_STEADY = (10, 0.5)
#: Share of the inlier landmarks of a pose that must still agree once rays have steadied it: rays may have
#: slid together, along a skirting board or a shadow, and where landmarks are few they would outvote them.
_MIN_KEPT_SHARE = 0.8
#: Landmark errors are cut off here, in standard deviations, when the costs of two poses are compared.
_CUT_SIGMAS = 3.0
#: How much rays may raise that cost in all: what noise does with six unknowns.
_MOST_TAKEN = 12.0
#: And how much more for each landmark: in a scene at rest it is up to 0.18, and 0.2 to 8 where the rays are
#: of something that moves by itself.
_MOST_TAKEN_EACH = 0.2
#: Landmarks leave a turn in doubt where its standard deviation is more pixels than this. They lie together
#: then, so their own errors are alike: rays may contradict them by as much as they gain.
_TURN_IN_DOUBT_PX = 1.0
#: Steps by which rays steady a pose that landmarks are sure of, and one that they are not.
_FEW_STEPS, _MOST_STEPS = 6, 10
#: With fewer landmarks in sight than this, rays may carry the pose on.
_RUN_OUT = 30
#: Number and share of rays that must agree for that.
_CARRY = (60, 0.6)
#: Landmarks that must be left and agree: without any, nothing tells turning from moving.
_MIN_LEFT = 4


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
        min_share: Share of the landmarks in sight that must agree, ``MIN_INLIERS`` at least: fewer are a
            chance find.
        may_carry: Where landmarks have all but run out, let many other tracks carry the guess on with fewer
            than ``MIN_INLIERS``.
        is_after_gap: Frames are missing before this one: what contradicts the guess must have more behind it.

    Returns:
        The pose, or None when too few landmarks agree with any.
    """
    known = world.landmarks.rows(seen.ids) >= 0
    marks, others = _SeenLandmarks.of(seen[known], world, noise), seen[~known]
    best = _pose_from_landmarks(camera, marks, T_world_guess, seed, is_after_gap=is_after_gap)
    enough = max(MIN_INLIERS, min_share * len(marks.xyz))
    if best is not None and best.num_inliers >= enough and np.isfinite(best.T_cam_world).all():
        # Near landmarks at one depth can't tell a turn from a way. Keyframes that followed them refute the
        # far view, which can: so all tracks are asked first, and landmarks tell whether they may be right.
        for with_refuted in (True, False) if much_is_refuted(world, submap) else (False,):
            rays = rays_of(camera, world, noise, others, submap, with_refuted=with_refuted)
            steadied = _steadied(camera, marks, rays, best, T_world_guess, enough)
            if steadied is not None:
                best = steadied
                break
    elif may_carry and T_world_guess is not None and len(marks.xyz) < _RUN_OUT:
        rays = rays_of(camera, world, noise, others, submap)
        left = max(_MIN_LEFT, min_share * len(marks.xyz))
        best = _with_rays(
            camera, marks, rays, invert_transform(T_world_guess), _CARRY, left, iterations=_MOST_STEPS
        )
    else:
        best = None
    if best is None:
        return None
    T_world_cam = invert_transform(best.T_cam_world)
    return TrackedPose(T_world_cam, best.covariance, marks.tracks.ids, best.inliers, best.residual_px)


@dataclass(frozen=True)
class _SeenLandmarks:
    """Tracks in sight that have a landmark.

    Attributes:
        tracks: ``N`` tracks.
        xyz: ``(N, 3)`` their landmarks, world frame.
        sigma_px: ``(N,)`` standard deviation of each observation per coordinate.
        gate_px: ``(N,)`` reprojection error up to which an observation is an inlier.
    """

    tracks: Seen
    xyz: Array
    sigma_px: Array
    gate_px: Array

    @classmethod
    def of(cls, tracks: Seen, world: WorldMap, noise: NoiseModel) -> "_SeenLandmarks":
        xyz = world.landmarks.xyz_of(tracks.ids)
        return cls(tracks, xyz, noise.sigma_px(tracks.confidence), noise.threshold_px(tracks.confidence))


def _pose_from_landmarks(
    camera: Intrinsics,
    marks: _SeenLandmarks,
    T_world_guess: Array | None,
    seed: int,
    *,
    is_after_gap: bool,
) -> PoseEstimate | None:
    """Refine the guess; search without it where there is none or few landmarks agree with the outcome."""
    observed = (marks.xyz, marks.tracks.xy, marks.sigma_px, marks.gate_px)
    edge, count = marks.tracks.edge, len(marks.xyz)
    best: PoseEstimate | None = None
    if T_world_guess is not None and count >= MIN_INLIERS:
        best = refine_pose(camera, invert_transform(T_world_guess), *observed, edge=edge)
    if best is None or best.num_inliers < max(MIN_INLIERS, _MIN_INLIER_SHARE * count):
        least, share = _BELIEVED_AFTER_GAP if is_after_gap else (0, 0.0)
        needed = max(MIN_INLIERS, least, math.ceil(share * count))
        searched = search_pose(camera, *observed, seed=seed, min_inliers=needed, edge=edge)
        if searched is not None and (best is None or searched.num_inliers > best.num_inliers):
            best = searched
    return best


def _steadied(
    camera: Intrinsics,
    marks: _SeenLandmarks,
    rays: RayObservations | None,
    before: PoseEstimate,
    T_world_guess: Array | None,
    enough: float,
) -> PoseEstimate | None:
    """Pose that landmarks and rays fit best, from the landmarks' own and, in doubt, from the expected one.

    Landmarks must agree with it, but for what noise does to them. Where they leave the turn in doubt, it must
    fit landmarks and rays together better than their own pose.

    Args:
        camera: Pinhole.
        marks: Tracks that have a landmark.
        rays: Those that have none.
        before: The landmarks' own pose.
        T_world_guess: Expected pose or None.
        enough: Landmarks that must agree, beside most of those that agreed before.

    Returns:
        The pose with the landmarks it agrees with; None where rays fit none that landmarks bear out.
    """
    is_in_doubt = _turn_is_in_doubt(before, camera)
    kept = max(enough, _MIN_KEPT_SHARE * before.num_inliers)
    starts = [before.T_cam_world]
    if is_in_doubt and T_world_guess is not None:
        starts.append(invert_transform(T_world_guess))
    iterations, compared = (_MOST_STEPS, rays) if is_in_doubt else (_FEW_STEPS, None)
    best, least = None, _cost(before, marks, compared, camera)
    if not is_in_doubt:
        least += _MOST_TAKEN + _MOST_TAKEN_EACH * len(marks.xyz)
    for start in starts:
        found = _with_rays(camera, marks, rays, start, _STEADY, kept, iterations=iterations)
        if found is not None and (cost := _cost(found, marks, compared, camera)) < least:
            best, least = found, cost
    return best


def _with_rays(
    camera: Intrinsics,
    marks: _SeenLandmarks,
    rays: RayObservations | None,
    T_cam_world: Array,
    needed: tuple[int, float],
    min_inliers: float,
    *,
    iterations: int,
) -> PoseEstimate | None:
    """Refine a pose with what the tracks without a landmark say too.

    Args:
        camera: Pinhole.
        marks: Tracks that have a landmark.
        rays: Those that have none.
        T_cam_world: Where to begin.
        needed: Number of rays that must agree, and the share of all rays.
        min_inliers: Landmarks that must agree.
        iterations: Steps at most. The first ones ask all rays, also those far off: something that moves by
            itself then contradicts the landmarks, where a few of its tracks alone would pull a little.

    Returns:
        The pose with the landmarks it agrees with; None where too few agree.
    """
    if rays is None or len(rays) < needed[0]:
        return None
    observed = (marks.xyz, marks.tracks.xy, marks.sigma_px, marks.gate_px)
    edge = marks.tracks.edge
    pose = refine_pose(camera, T_cam_world, *observed, iterations=iterations, rays=rays, edge=edge)
    num_agreeing = int((rays.sizes(camera, pose.T_cam_world) < rays.gate).sum())
    if pose.num_inliers < min_inliers or num_agreeing < max(needed[0], needed[1] * len(rays)):
        return None
    return pose


def _turn_is_in_doubt(pose: PoseEstimate, camera: Intrinsics) -> bool:
    """Tell whether landmarks alone leave it open by how much the camera turned."""
    if pose.covariance is None:
        return True
    sigma_rad = np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])
    return bool(sigma_rad * min(camera.fx, camera.fy) > _TURN_IN_DOUBT_PX)


def _cost(
    pose: PoseEstimate, marks: _SeenLandmarks, rays: RayObservations | None, camera: Intrinsics
) -> float:
    """Sum of the squared errors of landmarks, and of rays if given, in standard deviations, each cut off."""
    sizes = pose.residual_px / marks.sigma_px
    if rays is not None:
        sizes = np.concatenate([sizes, rays.sizes(camera, pose.T_cam_world)])
    return float((np.minimum(sizes, _CUT_SIGMAS) ** 2).sum())
