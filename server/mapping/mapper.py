"""From keyframes to the map: when to take one, triangulation, applying an adjustment, and culling."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import NoiseModel, OnlineNoise
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult, Observations
from semcast.server.mapping.refuted import on_something_large, with_neighbours
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Root mean square error of a triangulated landmark at most, in standard deviations.
MAX_ERROR_SIGMA = 1.8
#: RMS error in standard deviations from which on a track seen at least twice is no point at rest: it slipped,
#: or is on something that moves by itself.
_REFUTED_SIGMA = 4.0
#: Landmarks further than this many median depths are as good as at infinity.
_MAX_DEPTH_RATIO = 60.0
#: Noise is judged by residuals that keep at least this share of its variance.
_MIN_LEFT = 0.1
#: Where landmarks run out, points with less parallax are accepted, down to this share of the usual angle: a
#: camera that turns leaves all it knows, and sees hardly anything from two sides.
_LEAST_PARALLAX_SHARE = 0.3
#: A keyframe is needed when fewer landmarks agree with the pose than this share of those right after the last
#: keyframe: the pose soon rests on too little.
_FEW_SHARE = 0.45
#: The same as a number of landmarks.
_FEW = 40
#: A keyframe is wanted early, for new landmarks in time, at this share of those landmarks.
_THINNED_SHARE = 0.75
#: And with fewer tracks in sight than this share of ``max_features``.
_SPARSE_SHARE = 0.6
#: A frame with a smaller share of its rows is damaged and shows little.
_DAMAGED_SHARE = 0.5
#: Frames between the last keyframe and a damaged one, at least.
_DAMAGED_APART = 5
#: Flow since the last keyframe, in image widths, below which the camera stands: another keyframe would bring
#: neither parallax nor new views.
_STANDING_WIDTHS = 0.004
#: Flow from which on a keyframe wanted early is worth it.
_CHANGING_WIDTHS = 0.02
#: Frames since the last keyframe after which it is, whatever the flow.
_APART = 2
#: Flow from which on the view is another one.
_MOVED_WIDTHS = 0.045
#: The distance between keyframes tells a scale only above this share of the scene's depth.
_LEAST_WAY = 0.002
#: Observations in a row that disagree before a landmark is given up.
_MAX_MISSED = 4


@dataclass(frozen=True)
class KeyframeCues:
    """What the keyframe rule looks at.

    Attributes:
        num_inliers: Landmarks that agree with the pose.
        num_inliers_at_keyframe: The same right after the last keyframe.
        num_visible: Tracks in sight.
        max_features: Tracks wanted.
        median_flow_px: How far tracks have moved since the last keyframe, see ``median_flow_px``.
        width_px: Of the image.
        frames_since: Frames since the last keyframe.
        usable_share: Share of image rows that arrived.
    """

    num_inliers: int
    num_inliers_at_keyframe: int
    num_visible: int
    max_features: int
    median_flow_px: float
    width_px: int
    frames_since: int
    usable_share: float


def wants_keyframe(cues: KeyframeCues) -> bool:
    """Decide on a keyframe: the view has changed, or landmarks are running out.

    A frame of which much is missing becomes one only in need.
    """
    few = cues.num_inliers < max(_FEW_SHARE * cues.num_inliers_at_keyframe, _FEW)
    if cues.usable_share < _DAMAGED_SHARE:
        return few and cues.frames_since >= _DAMAGED_APART
    if cues.median_flow_px < _STANDING_WIDTHS * cues.width_px:
        return False
    thinned = cues.num_inliers < _THINNED_SHARE * cues.num_inliers_at_keyframe
    sparse = cues.num_visible < _SPARSE_SHARE * cues.max_features
    moved = cues.median_flow_px > _MOVED_WIDTHS * cues.width_px
    changing = cues.frames_since >= _APART or cues.median_flow_px > _CHANGING_WIDTHS * cues.width_px
    return few or moved or ((thinned or sparse) and changing)


def median_flow_px(reference: Keyframe, ids: Ids, xy: Array) -> float:
    """How far tracks have moved since a keyframe, without those on something large that moves by itself.

    Args:
        reference: The keyframe.
        ids: ``(N,)`` tracks in sight, ascending.
        xy: ``(N, 2)`` where.

    Returns:
        Median in pixels; infinite where the keyframe saw none of the tracks.
    """
    _, row, row_k = np.intersect1d(ids, reference.ids, assume_unique=True, return_indices=True)
    at_rest = ~np.isin(ids[row], on_something_large(reference))
    flow_px = np.linalg.norm(xy[row[at_rest]] - reference.xy[row_k[at_rest]], axis=1)
    return float(np.median(flow_px)) if len(flow_px) else float("inf")


def add_landmarks(
    world: WorldMap,
    camera: Intrinsics,
    noise: NoiseModel,
    image: NDArray[np.uint8],
    min_parallax_deg: float,
    *,
    enough: int = 0,
    num_keyframes: int = 12,
) -> int:
    """Triangulate the tracks of the newest keyframe that are no landmarks yet; returns the number added.

    Args:
        world: The map, grown.
        camera: Pinhole.
        noise: Of the observations.
        image: The newest keyframe's, ``(H, W, 3)``, for the colours.
        min_parallax_deg: Angle between the rays of a point.
        enough: With fewer landmarks in sight than this, smaller angles are accepted.
        num_keyframes: The newest keyframes whose observations are used.
    """
    newest = world.keyframes[-1]
    is_new = world.landmarks.rows(newest.ids) < 0
    wanted = newest.ids[is_new]
    num_known = len(newest.ids) - len(wanted)
    if num_known < enough:
        min_parallax_deg *= max(num_known / enough, _LEAST_PARALLAX_SHARE)
    views = [k for k in world.keyframes[-num_keyframes:] if k.submap == newest.submap]
    reach = median_depth(world, newest)
    new = new_landmarks(camera, views, newest, wanted, noise, min_parallax_deg, reach)
    newest.refuted = new.refuted
    newest.refuted = with_neighbours(newest, ~is_new, camera.width)
    new = new.without(newest.refuted)
    row = np.searchsorted(newest.ids, new.ids)
    rgb = sample_colours(image, newest.xy[row])
    world.add_landmarks(new.ids, new.xyz, rgb, new.confidence, newest.submap, newest.frame_id)
    return len(new.ids)


@dataclass(frozen=True)
class NewLandmarks:
    """Points made of tracks.

    Attributes:
        ids: ``(P,)`` int64, ascending.
        xyz: ``(P, 3)`` world frame.
        confidence: ``(P,)`` mean over observations.
        refuted: ``(R,)`` int64, ascending: tracks that are seen where no point at rest can be.
    """

    ids: Ids
    xyz: Array
    confidence: Array
    refuted: Ids

    def without(self, ids: Ids) -> "NewLandmarks":
        """Return the same without the points of some tracks."""
        kept = ~np.isin(self.ids, ids)
        return replace(self, ids=self.ids[kept], xyz=self.xyz[kept], confidence=self.confidence[kept])


def new_landmarks(
    camera: Intrinsics,
    views: Sequence[Keyframe],
    seen_from: Keyframe,
    wanted: Ids,
    noise: NoiseModel,
    min_parallax_deg: float,
    median_depth_map: float,
) -> NewLandmarks:
    """Triangulate tracks that are no landmarks yet.

    A point must have its rays more than ``min_parallax_deg`` apart, be in front of all its cameras and fit
    its observations within ``MAX_ERROR_SIGMA``.

    Args:
        camera: Pinhole.
        views: Keyframes that may have seen them.
        seen_from: The one of them whose landmarks they will be.
        wanted: ``(W,)`` ids of the tracks, ascending.
        noise: Of the observations.
        min_parallax_deg: Angle between rays.
        median_depth_map: Of what ``seen_from`` sees; points many times as far are as good as at infinity.
    """
    view, point, xy, confidence, edge = gather_observations(views, wanted)
    seen = np.bincount(point, minlength=len(wanted))
    if not (seen >= 2).any():
        return NewLandmarks(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    T_cam_world = invert_transform(np.stack([k.T_world_cam for k in views]))
    sigma = noise.sigma_px(confidence)
    points = triangulate(camera, T_cam_world, view, point, xy, sigma, len(wanted), edge=edge)
    depth = depths_in(invert_transform(seen_from.T_world_cam), points.xyz)
    # A fixed error in pixels is what an angle is compared with: noisy images need more parallax.
    wanted_deg = max(min_parallax_deg, float(np.degrees(2.5 * np.median(sigma) / camera.fx)))
    good = (
        (seen >= 2)
        & points.in_front
        & (points.parallax_deg > wanted_deg)
        & (points.error_sigma < MAX_ERROR_SIGMA)
        & (depth < _MAX_DEPTH_RATIO * median_depth_map)
    )
    total = np.bincount(point, weights=confidence, minlength=len(wanted))
    refuted = wanted[(seen >= 2) & (points.error_sigma > _REFUTED_SIGMA)]
    return NewLandmarks(wanted[good], points.xyz[good], (total / np.maximum(1, seen))[good], refuted)


def sample_colours(image: NDArray[np.uint8], xy: Array) -> NDArray[np.uint8]:
    """Colour ``(N, 3)`` uint8 of the pixel of an ``(H, W, 3)`` image nearest to each of ``(N, 2)`` pixels."""
    height, width = image.shape[:2]
    x = np.clip(np.rint(xy[:, 0]), 0, width - 1).astype(np.intp)
    y = np.clip(np.rint(xy[:, 1]), 0, height - 1).astype(np.intp)
    return np.asarray(image[y, x])


class Seen(Protocol):
    """What a view saw: a keyframe, or a frame that waits for a map."""

    @property
    def ids(self) -> Ids:
        """``(M,)`` tracks."""

    @property
    def xy(self) -> Array:
        """``(M, 2)`` pixels."""

    @property
    def confidence(self) -> Array:
        """``(M,)``."""

    @property
    def edge(self) -> Array:
        """``(M, 2)``."""


def gather_observations(views: Sequence[Seen], ids: Ids) -> Observations:
    """Find every observation of some tracks in some views.

    Args:
        views: One at least; each sees a track once.
        ids: ``(P,)`` tracks, ascending.

    Returns:
        View ``(M,)``, row into ``ids (M,)``, pixel ``(M, 2)``, confidence ``(M,)`` and edge ``(M, 2)`` of
        each, view by view.
    """
    view, point, xy, confidence, edge = [], [], [], [], []
    for k, keyframe in enumerate(views):
        row = np.minimum(np.searchsorted(ids, keyframe.ids), max(0, len(ids) - 1))
        hit = ids[row] == keyframe.ids if len(ids) else np.zeros(len(keyframe.ids), bool)
        view.append(np.full(int(hit.sum()), k, np.intp))
        point.append(row[hit].astype(np.intp))
        xy.append(keyframe.xy[hit])
        confidence.append(keyframe.confidence[hit])
        edge.append(keyframe.edge[hit])
    return Observations(*(np.concatenate(column) for column in (view, point, xy, confidence, edge)))


def median_depth(world: WorldMap, keyframe: Keyframe) -> float:
    """Median depth of a keyframe's landmarks in map units; infinite when it sees none."""
    return median_depth_of(keyframe, world.landmarks.ids, world.landmarks.xyz)


def usual_depth(world: WorldMap, enough: int) -> float:
    """Median depth of what the newest keyframe sees that sees ``enough`` landmarks.

    The last ones before a loss see few, and those a camera that turned made under the smallest angles: their
    depth is anything. Where none sees enough, it is that of the newest; 1 without any landmark.
    """
    newest = world.keyframes[::-1]
    seen = (k for k in newest if (world.landmarks.rows(k.ids) >= 0).sum() >= enough)
    depth = median_depth(world, next(seen, newest[0])) if newest else 1.0
    return depth if np.isfinite(depth) else 1.0


def median_depth_of(keyframe: Keyframe, ids: Ids, xyz: Array) -> float:
    """Return the same for points ``ids (P,)``, ascending, at ``xyz (P, 3)``."""
    _, row, _ = np.intersect1d(ids, keyframe.ids, assume_unique=True, return_indices=True)
    if len(row) == 0:
        return float("inf")
    depth = depths_in(invert_transform(keyframe.T_world_cam), xyz[row])
    return float(np.median(np.maximum(depth, 1e-6)))


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
    drop_outliers(world, result, noise.model)


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
    before, after = _ways(problem.T_world_cam), _ways(result.T_world_cam)
    is_told = ~problem.fixed & (before > _LEAST_WAY * depth)
    return np.where(is_told, after / np.where(is_told, before, 1.0), 1.0)


def _ways(T_world_cam: Array) -> Array:
    """Sum of the distances, ``(K,)``, from each of ``(K, 4, 4)`` poses to those before and after it."""
    ways = np.zeros(len(T_world_cam))
    steps = np.linalg.norm(np.diff(T_world_cam[:, :3, 3], axis=0), axis=1)
    ways[:-1] += steps
    ways[1:] += steps
    return ways


def drop_outliers(world: WorldMap, result: BundleResult, noise: NoiseModel) -> None:
    """Drop observations outside the gate, and landmarks left with fewer than two of them."""
    problem = result.problem
    size = np.linalg.norm(np.nan_to_num(result.whitened_px, nan=np.inf), axis=1)
    _drop(world, problem, size > 1.3 * noise.threshold_px(problem.confidence))


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


def note_sight(world: WorldMap, ids: Ids, agrees: NDArray[np.bool_], frame_id: int) -> None:
    """Note which landmarks a frame saw and which of them agreed; those that keep disagreeing are removed.

    Args:
        world: The map.
        ids: ``(N,)`` landmarks the frame saw; those that are not there any more are passed over.
        agrees: ``(N,)`` which agree with its pose.
        frame_id: The frame.
    """
    row = world.landmarks.rows(ids)
    there = row >= 0
    row, agrees = row[there], agrees[there]
    world.landmarks.last_seen[row[agrees]] = frame_id
    world.landmarks.num_missed[row[agrees]] = 0
    world.landmarks.num_missed[row[~agrees]] += 1
    world.remove_landmarks(world.landmarks.num_missed >= _MAX_MISSED)
