"""Where am I? Descriptors of the current image against keyframes, then PnP; and joining two submaps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.corners import detect_corners
from semcast.server.geometry.descriptors import Describer, count_matches, hamming, match_descriptors
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.pnp import PoseEstimate, refine_pose, search_pose
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.square_distance import square_distances
from semcast.server.geometry.weighting import GATE_SIGMAS, NoiseModel
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: The newest keyframes, which are tried on every frame.
_NUM_NEWEST = 2
#: Older keyframes that are compared with an image, at most.
MAX_CONSIDERED = 40
#: The likeliest of those, which are tried too.
_NUM_LIKELIEST = 2
#: Descriptors of the image by which likely keyframes are told.
_NUM_COMPARED = 200
#: How many of them a likely keyframe must have.
_MIN_ALIKE = 4
#: Inlier matches of the first search that are worth a closer look.
_MIN_FIRST = 9
#: Inlier landmarks that prove a place, as a share of ``max_features``,
_MIN_INLIER_SHARE = 0.09
#: but no fewer than this: fewer were found by chance where texture repeats.
_MIN_INLIERS = 20
#: This many are enough in any case.
_MAX_MIN_INLIERS = 45
#: Keyframes around the recognised one whose landmarks are looked for.
_NEIGHBOURS = 5
#: Hypotheses of a search by the landmarks of one keyframe, at most: most keyframes are not the place.
_SEARCH_ITERATIONS = 400
#: How far from where the first pose has a landmark its corner is looked for,
_GUIDED_RADIUS_PX = 14.0
#: by how many bits descriptors may differ there: more than where the whole image is a rival,
_GUIDED_MAX_BITS = 70
#: and share of those found that must agree with the refined pose.
_MIN_GUIDED_SHARE = 0.35
#: A wrong one of a row of equal houses has none of what stands around it. Found landmarks must be distributed
#: over the image like those that should be in view: this is the Bhattacharyya coefficient they need. In 650
#: measurements it was at most 0.73 at wrong places, and at 6 of 618 right ones.
_LEAST_ALIKE = 0.73
#: Fields of the image, across and down, over which that is measured.
_FIELDS_XY = (12, 5)
#: Of one frame's points in two submaps, those nearer than this in the image are the same.
_SAME_PX = 3.0
#: Corners of the query at most, and side of the cells over which they are spread.
_NUM_CORNERS, _CELL_PX = 800, 40
#: Octaves of the query, so that a view from nearer or further still matches.
_OCTAVES = (0, 2, 4)
#: Binary descriptors do not know the noise model: a match is good to about this.
_MATCH_SIGMA_PX = 1.5
#: Points that two submaps must share to tell the ratio of their units.
_MIN_SHARED = 8
#: Median deviation, as a logarithm, of the depth ratios of those points at most: at wrong places ratios are
#: of all sizes.
_MAX_LOG_SPREAD = 0.25


@dataclass(frozen=True)
class Place:
    """A pose found without a prior.

    Attributes:
        T_world_cam: ``(4, 4)``.
        keyframe_id: The keyframe that was recognised.
        ids: ``(N,)`` landmarks that agree.
        xy: ``(N, 2)`` where they are in the image.
        submap: Of the keyframe.
        proof: The pose as patches prove it, with which all these landmarks agree within the error of patches;
            None where descriptors alone tell the place.
    """

    T_world_cam: Array
    keyframe_id: int
    ids: Ids
    xy: Array
    submap: int
    proof: PoseEstimate | None = None


def _anywhere(_: Place) -> bool:
    return True


class Relocaliser:
    """Recognises keyframes.

    Args:
        camera: Pinhole.
        seed: Of the pose search.
        max_features: Keypoints followed at most.
    """

    def __init__(self, camera: Intrinsics, seed: int, max_features: int) -> None:
        self._camera = camera
        self._min_inliers = int(np.clip(_MIN_INLIER_SHARE * max_features, _MIN_INLIERS, _MAX_MIN_INLIERS))
        self._seed = seed
        self._describer = Describer()
        self._turn = 0

    def describe(self, grey: Grey, ids: Ids, xy: Array) -> tuple[Ids, NDArray[np.uint8]]:
        """Descriptors of a keyframe's tracks: ids and ``(D, 32)`` uint8."""
        rows, descriptors = self._describer.describe(grey, xy)
        return ids[rows], descriptors

    def find(
        self,
        sight: Sight,
        world: WorldMap,
        noise: NoiseModel,
        submaps: set[int] | None = None,
        is_possible: Callable[[Place], bool] = _anywhere,
    ) -> Place | None:
        """Look for the place of an image among keyframes: the newest ones and, in turn, all others.

        Args:
            sight: The image.
            world: The map.
            noise: Of observations.
            submaps: Only keyframes of these, None for all.
            is_possible: Whether the camera can be at a place.
        """
        known = [k for k in world.keyframes if submaps is None or k.submap in submaps]
        newest, older = known[-_NUM_NEWEST:], known[:-_NUM_NEWEST]
        count = min(len(older), MAX_CONSIDERED)
        turn = [older[-1 - (self._turn + k) % len(older)] for k in range(count)]
        self._turn = (self._turn + count) % max(1, len(older))
        return self.recognise(sight, world, noise, turn, tried_anyway=newest[::-1], is_possible=is_possible)

    def recognise(
        self,
        sight: Sight,
        world: WorldMap,
        noise: NoiseModel,
        candidates: Sequence[Keyframe],
        tried_anyway: Sequence[Keyframe] = (),
        is_possible: Callable[[Place], bool] = _anywhere,
    ) -> Place | None:
        """Look for the place of an image among some keyframes.

        Args:
            sight: The image.
            world: The map.
            noise: Of observations.
            candidates: Keyframes of which the two with the most similar descriptors are tried.
            tried_anyway: Keyframes that are tried before these.
            is_possible: Whether the camera can be at a place.
        """
        if not candidates and not tried_anyway:
            return None
        seen = detect_corners(sight.grey, _NUM_CORNERS, usable=sight.usable_pixels, cell_px=_CELL_PX)
        corners = seen.astype(np.float64)
        rows, descriptors = self._describer.describe(sight.grey, corners, _OCTAVES)
        if len(rows) < _MIN_FIRST:
            return None
        sigma_px = max(_MATCH_SIGMA_PX, noise.sigma0_px)
        for keyframe in [*tried_anyway, *_likeliest(candidates, descriptors)]:
            ids, known = _pool(world, [keyframe])
            mine, theirs = match_descriptors(descriptors, known)
            found = self._search(world, ids[theirs], corners[rows[mine]], sigma_px)
            if found is None:
                continue
            place = self._confirm(world, keyframe, found, corners[rows], descriptors, sigma_px)
            if place is not None and is_possible(place):
                return place
        return None

    def _search(self, world: WorldMap, ids: Ids, xy: Array, sigma_px: float) -> PoseEstimate | None:
        sigma = np.full(len(xy), sigma_px)
        points = world.landmarks.xyz_of(ids)
        return search_pose(
            self._camera,
            points,
            xy,
            sigma,
            GATE_SIGMAS * sigma,
            seed=self._seed,
            min_inliers=_MIN_FIRST,
            max_iterations=_SEARCH_ITERATIONS,
        )

    def _confirm(
        self,
        world: WorldMap,
        keyframe: Keyframe,
        found: PoseEstimate,
        xy: Array,
        descriptors: NDArray[np.uint8],
        sigma_px: float,
    ) -> Place | None:
        """Look for more landmarks where the pose expects them; a wrong pose finds few."""
        mine = world.keyframes_of(keyframe.submap)
        near = sorted(mine, key=lambda k: abs(k.frame_id - keyframe.frame_id))[:_NEIGHBOURS]
        ids, known = _pool(world, near)
        points = world.landmarks.xyz_of(ids)
        T = found.T_cam_world
        expected = self._camera.project(transform_points(T, points))
        size = (self._camera.width, self._camera.height)
        in_view = ((expected >= 0) & (expected < size)).all(axis=1)
        ids, known, points, expected = ids[in_view], known[in_view], points[in_view], expected[in_view]
        point, row = _guided_matches(expected, known, xy, descriptors)
        if len(point) < self._min_inliers:
            return None
        sigma = np.full(len(point), sigma_px)
        refined = refine_pose(self._camera, T, points[point], xy[row], sigma, GATE_SIGMAS * sigma)
        if refined.num_inliers < max(self._min_inliers, _MIN_GUIDED_SHARE * len(point)):
            return None
        good = refined.inliers
        if self._alike(expected, xy[row][good]) < _LEAST_ALIKE:
            return None
        return Place(
            invert_transform(refined.T_cam_world),
            keyframe.frame_id,
            ids[point][good],
            xy[row][good],
            keyframe.submap,
        )

    def _alike(self, in_view_xy: Array, found_xy: Array) -> float:
        """Bhattacharyya coefficient of how two sets of pixels ``(N, 2)`` and ``(M, 2)`` lie in the image."""
        size = ((0, self._camera.width), (0, self._camera.height))
        p, q = (np.histogramdd(xy, _FIELDS_XY, size)[0] / len(xy) for xy in (in_view_xy, found_xy))
        return float(np.sqrt(p * q).sum())


def _guided_matches(
    expected_xy: Array, known: NDArray[np.uint8], xy: Array, descriptors: NDArray[np.uint8]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Match landmarks with the most similar of the corners near to where they are expected.

    Args:
        expected_xy: ``(N, 2)`` where landmarks are expected.
        known: ``(N, 32)`` their descriptors.
        xy: ``(M, 2)`` corners.
        descriptors: ``(M, 32)`` theirs.

    Returns:
        Rows of the landmarks that have a match, ascending, and of the corners.
    """
    point, row = np.nonzero(square_distances(expected_xy, xy) < _GUIDED_RADIUS_PX**2)
    distance = hamming(known[point], descriptors[row])
    order = np.lexsort((row, distance, point))
    best = order[np.unique(point[order], return_index=True)[1]]
    best = best[distance[best] <= _GUIDED_MAX_BITS]
    return point[best], row[best]


def _likeliest(candidates: Sequence[Keyframe], descriptors: NDArray[np.uint8]) -> list[Keyframe]:
    """Return the keyframes with the most descriptors like those of an image."""
    some = descriptors[:: -(-len(descriptors) // _NUM_COMPARED)]
    alike = np.array([count_matches(some, keyframe.descriptors) for keyframe in candidates], dtype=np.int64)
    best = np.argsort(-alike, kind="stable")[:_NUM_LIKELIEST]
    return [candidates[k] for k in best.tolist() if alike[k] >= _MIN_ALIKE]


def _pool(world: WorldMap, keyframes: list[Keyframe]) -> tuple[Ids, NDArray[np.uint8]]:
    """Ids and descriptors of all landmarks in keyframes, of several descriptors the first."""
    ids = np.concatenate([k.descriptor_ids for k in keyframes])
    descriptors = np.concatenate([k.descriptors for k in keyframes])
    known = np.flatnonzero(world.landmarks.rows(ids) >= 0)
    unique, first = np.unique(ids[known], return_index=True)
    return unique, descriptors[known[first]]


def submap_similarity(
    place: Place, world: WorldMap, T_world_cam_new: Array, ids_new: Ids, xy_new: Array
) -> tuple[float, Array] | None:
    """Similarity that brings the newer submap onto the older one, from one frame that sees both.

    The pose gives rotation and translation; the scale is the ratio of depths of points that both maps know.

    Args:
        place: The frame's pose in the older submap.
        world: The map.
        T_world_cam_new: The frame's pose in the newer submap.
        ids_new: ``(M,)`` tracks of the frame.
        xy_new: ``(M, 2)`` where they are.

    Returns:
        ``(scale, T)`` with ``x_old = T @ (scale * x_new)``, or None when too few points are in both.
    """
    row_new = world.landmarks.rows(ids_new)
    known = row_new >= 0
    if int(known.sum()) < _MIN_SHARED or len(place.ids) < _MIN_SHARED:
        return None
    square = square_distances(place.xy, xy_new[known])
    nearest = square.argmin(axis=1)
    close = square[np.arange(len(place.xy)), nearest] < _SAME_PX**2
    if int(close.sum()) < _MIN_SHARED:
        return None
    xyz_old = world.landmarks.xyz_of(place.ids[close])
    xyz_new = world.landmarks.xyz[row_new[known][nearest[close]]]
    depth_old = depths_in(invert_transform(place.T_world_cam), xyz_old)
    depth_new = depths_in(invert_transform(T_world_cam_new), xyz_new)
    valid = (depth_old > 1e-6) & (depth_new > 1e-6)
    if int(valid.sum()) < _MIN_SHARED:
        return None
    ratio = depth_old[valid] / depth_new[valid]
    scale = float(np.median(ratio))
    if float(np.median(np.abs(np.log(ratio / scale)))) > _MAX_LOG_SPREAD:
        return None
    T_scaled_cam = T_world_cam_new.copy()
    T_scaled_cam[:3, 3] *= scale
    return scale, place.T_world_cam @ invert_transform(T_scaled_cam)
