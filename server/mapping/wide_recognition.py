"""Where am I after a gap? SIFT against the newest keyframes, then their landmarks by warped patches.

Binary descriptors of upright corners recognise a place from nearly where it was seen. A camera that went on
for a second sees it turned and from elsewhere. What looks as it did there, once pose and depth have warped
it, proves the place, and says to a fraction of a pixel where each landmark is.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.common.sequence import resized
from semcast.server.geometry.features import Grey
from semcast.server.geometry.patch_alignment import (
    ANCHOR_PATCH_PX,
    MIN_AREA_RATIO,
    Templates,
    affine_warps,
    align_patches,
    seen_alike,
)
from semcast.server.geometry.pnp import PoseEstimate, refine_pose, search_pose
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.square_distance import square_distances
from semcast.server.geometry.weighting import GATE_SIGMAS, NoiseModel
from semcast.server.geometry.wide_search import WideFeatures, clear_matches, expected_matches
from semcast.server.mapping.keyframe_images import KeyframeImages, SeenFrom
from semcast.server.mapping.relocalisation import Place
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes that are looked at, the newest ones.
_NUM_KEYFRAMES = 3
#: Frames after which a camera that was not found with them is somewhere else: a look takes as long as
#: everything else of a frame.
_MAX_FRAMES = 8
#: Ratio of distances up to which a nearest descriptor counts: landmarks tell wrong matches surely.
_MAX_RATIO = 0.85
#: A feature is taken to be as far as the landmark next to it, where there is one this near,
_MAX_OFFSET_PX = 15.0
#: and its place is then good to this standard deviation.
_MATCH_SIGMA_PX = 2.5
#: How far from where a rough pose has them features are looked for again,
_NEAR_PX = 20.0
#: and how far from where the camera's motion has them.
_EXPECTED_PX = 60.0
#: Landmarks that must agree with a pose. Of a few dozen wrong matches hardly two are within pixels of any.
_MIN_FIRST = 8
#: Share of a keyframe's landmarks that must look as they did where the pose has them, one for each round of
#: looking: the first pose is a rough one.
_LEAST_SHARES = (0.0, 0.0, 0.2)
#: Share of those that must agree with the pose of the next round.
_MIN_AGREEING_SHARE = 0.5
_ALIGNED_SIGMA_PX = 1.0
#: Standard deviation of a recognised rotation at most: errors were up to five times as large.
_MAX_SIGMA_RAD = np.radians(0.5)
_BORDER_PX = 8
_SEARCH_ITERATIONS = 400


@dataclass(frozen=True)
class _View:
    """A keyframe and the landmarks it saw.

    Attributes:
        keyframe: Itself.
        image: Its image.
        ids: ``(N,)`` landmarks.
        xy: ``(N, 2)`` where it saw them.
        xyz: ``(N, 3)`` where they are.
        depth: ``(N,)`` along its axis.
    """

    keyframe: Keyframe
    image: SeenFrom
    ids: Ids
    xy: Array
    xyz: Array
    depth: Array

    @staticmethod
    def of(image: SeenFrom, keyframe: Keyframe, world: WorldMap) -> "_View":
        """Gather what a keyframe saw of the map."""
        row = world.landmarks.rows(keyframe.ids)
        row, seen = row[row >= 0], row >= 0
        xyz = world.landmarks.xyz[row]
        depth = depths_in(invert_transform(keyframe.T_world_cam), xyz)
        return _View(keyframe, image, keyframe.ids[seen], keyframe.xy[seen], xyz, depth)

    def points(self, camera: Intrinsics, features: WideFeatures) -> tuple[WideFeatures, Array]:
        """Features that have a landmark next to them, and where they are if they are as far, ``(M, 3)``."""
        if len(self.ids) == 0:
            return features[np.zeros(0, np.intp)], np.zeros((0, 3))
        square = square_distances(features.xy, self.xy)
        next_to = square.argmin(axis=1)
        near = square[np.arange(len(next_to)), next_to] < _MAX_OFFSET_PX**2
        near &= self.depth[next_to] > 0.0
        in_cam = camera.unproject(features.xy[near]) * self.depth[next_to[near], None]
        return features[near], transform_points(self.keyframe.T_world_cam, in_cam)


class _Known(NamedTuple):
    """Features of a keyframe's image, as ``WideFeatures.of`` found them."""

    image: SeenFrom
    fine: bool
    features: WideFeatures


@dataclass(frozen=True)
class _Aligned:
    """Landmarks of a keyframe that were found.

    Attributes:
        ids: ``(N,)`` of them.
        xyz: ``(N, 3)`` where they are in the world.
        xy: ``(N, 2)`` and in the image.
        num_looked_for: Of all of them.
    """

    ids: Ids
    xyz: Array
    xy: Array
    num_looked_for: int


class WideRecogniser:
    """Recognises the newest keyframes from further away than ``Relocaliser``.

    Args:
        camera: Pinhole.
        seed: Of the pose search.
    """

    def __init__(self, camera: Intrinsics, seed: int) -> None:
        self._camera = camera
        self._seed = seed
        self._known: list[_Known] = []
        self._looked_for: tuple[int, int] = (-1, 0)

    def find(
        self,
        sight: Sight,
        world: WorldMap,
        images: KeyframeImages,
        noise: NoiseModel,
        T_world_expected: Array | None = None,
    ) -> Place | None:
        """Look for the place of an image among the newest keyframes, in the first frames after the newest.

        Args:
            sight: The image.
            world: The map.
            images: Of keyframes.
            noise: Of observations.
            T_world_expected: ``(4, 4)`` where the camera has got to if it went on as it did.
        """
        there = [(image, world.keyframe(image.frame_id)) for image in images.newest(_NUM_KEYFRAMES)]
        newest = [(image, keyframe) for image, keyframe in reversed(there) if keyframe is not None]
        if not newest:
            return None
        last_id, num_looked = self._looked_for
        newest_id = newest[0][1].frame_id
        num_looked = num_looked if newest_id == last_id else 0
        if num_looked == _MAX_FRAMES:
            return None
        self._looked_for = newest_id, num_looked + 1
        self._known = [k for k in self._known if any(k.image is image for image, _ in newest)]
        views = [_View.of(image, keyframe, world) for image, keyframe in newest]
        T_cam_expected = None if T_world_expected is None else invert_transform(T_world_expected)
        for view, fine in [*((view, False) for view in views), (views[0], True)]:
            for start in self._starts(sight, view, T_cam_expected, noise, fine=fine):
                found = self._proved(sight, view, start, noise)
                place = None if found is None else self._place(sight, view, views, found, noise)
                if place is not None:
                    return place
        return None

    def _features_of(self, image: SeenFrom, *, fine: bool) -> WideFeatures:
        """Features of a keyframe, kept as long as its image is neither old nor replaced."""
        known = next((k.features for k in self._known if k.image is image and k.fine == fine), None)
        if known is None:
            known = WideFeatures.of(image.grey, fine=fine)
            self._known.append(_Known(image, fine, known))
        return known

    def _starts(
        self, sight: Sight, view: _View, T_cam_expected: Array | None, noise: NoiseModel, *, fine: bool
    ) -> Iterator[PoseEstimate]:
        """Rough poses, by features that have a landmark next to them: one without a prior, one with.

        Of a camera that has come much nearer the image has details that only ``fine`` features show.
        """
        known, xyz = view.points(self._camera, self._features_of(view.image, fine=fine))
        seen = sight.wide_features
        sigma_px = max(_MATCH_SIGMA_PX, noise.sigma0_px)

        def pose_of(rows: tuple[NDArray[np.intp], NDArray[np.intp]]) -> PoseEstimate | None:
            sigma = np.full(len(rows[0]), sigma_px)
            return search_pose(
                self._camera,
                xyz[rows[0]],
                seen.xy[rows[1]],
                sigma,
                GATE_SIGMAS * sigma,
                seed=self._seed,
                min_inliers=_MIN_FIRST,
                max_iterations=_SEARCH_ITERATIONS,
            )

        def near(T_cam_world: Array, reach_px: float) -> PoseEstimate | None:
            expected = self._camera.project(transform_points(T_cam_world, xyz))
            return pose_of(expected_matches(known, seen, expected, reach_px, _MAX_RATIO))

        if (found := pose_of(clear_matches(known, seen, _MAX_RATIO))) is not None:
            yield near(found.T_cam_world, _NEAR_PX) or found
        if T_cam_expected is not None and (found := near(T_cam_expected, _EXPECTED_PX)) is not None:
            yield near(found.T_cam_world, _NEAR_PX) or found

    def _proved(
        self, sight: Sight, view: _View, found: PoseEstimate, noise: NoiseModel
    ) -> PoseEstimate | None:
        """Pose of landmarks that look as a keyframe saw them, None where those are too few."""
        for least_share in _LEAST_SHARES:
            aligned = self._aligned(sight, view, found.T_cam_world)
            if len(aligned.ids) < max(_MIN_FIRST, least_share * aligned.num_looked_for):
                return None
            found = self._refined(found, aligned.xyz, aligned.xy, noise)
            if found.num_inliers < max(_MIN_FIRST, _MIN_AGREEING_SHARE * len(aligned.ids)):
                return None
        return found

    def _place(
        self, sight: Sight, proved: _View, views: list[_View], found: PoseEstimate, noise: NoiseModel
    ) -> Place | None:
        """Look for the landmarks of all views: a pose from far off rests on few of any single one.

        None where they hold the rotation loosely: a few that lie close together agree with many poses.

        Args:
            sight: The image.
            proved: The view that was recognised.
            views: All of them.
            found: The pose.
            noise: Of observations.
        """
        submap = proved.keyframe.submap
        mine = [proved, *(v for v in views if v is not proved and v.keyframe.submap == submap)]
        each = [self._aligned(sight, view, found.T_cam_world) for view in mine]
        # Where several saw a landmark, the place is that of the first: the view that was recognised.
        ids, first = np.unique(np.concatenate([a.ids for a in each]), return_index=True)
        xyz, xy = (np.concatenate([getattr(a, name) for a in each])[first] for name in ("xyz", "xy"))
        pose = self._refined(found, xyz, xy, noise)
        if pose.covariance is None or np.sqrt(np.trace(pose.covariance[:3, :3])) > _MAX_SIGMA_RAD:
            return None
        good, keyframe = pose.inliers, proved.keyframe
        T_world_cam = invert_transform(pose.T_cam_world)
        return Place(T_world_cam, keyframe.frame_id, ids[good], xy[good], keyframe.submap)

    def _aligned(self, sight: Sight, view: _View, T_cam_world: Array) -> _Aligned:
        """Look for all landmarks of a keyframe where a pose has them."""
        expected = self._camera.project(transform_points(T_cam_world, view.xyz))
        rows = np.flatnonzero(sight.shows(expected, _BORDER_PX) & (view.depth > 0.0))
        T_cam_keyframe = T_cam_world @ view.keyframe.T_world_cam
        warps, depth1 = affine_warps(self._camera, T_cam_keyframe, view.xy[rows], view.depth[rows])
        there, here = _reductions(warps)
        warps = warps * (there / here)
        alike = seen_alike(warps, depth1)
        rows, warps = rows[alike], warps[alike]
        expected_xy = _in_reduced(expected[rows], here)
        centres_xy = _in_reduced(view.xy[rows], there)
        templates = Templates.cut(_reduced(view.image.grey, there), centres_xy, ANCHOR_PATCH_PX)
        patches = align_patches(templates, _reduced(sight.grey, here), expected_xy, warps)
        fits = patches.fits(expected_xy)
        kept = rows[fits]
        # Back to pixels of the whole image.
        xy = _in_reduced(patches.xy[fits], 1.0 / here)
        return _Aligned(view.ids[kept], view.xyz[kept], xy, len(rows))

    def _refined(self, found: PoseEstimate, xyz: Array, xy: Array, noise: NoiseModel) -> PoseEstimate:
        """Pose of landmarks that were found."""
        sigma = np.full(len(xyz), max(_ALIGNED_SIGMA_PX, noise.sigma0_px))
        return refine_pose(self._camera, found.T_cam_world, xyz, xy, sigma, GATE_SIGMAS * sigma)


def _reductions(warps: Array) -> tuple[int, int]:
    """Return by what keyframe and image are reduced, so that their patches show the same details.

    A camera that is twice as near sees what the keyframe did not, and the keyframe what one that is twice as
    far away does not: the larger picture at half its size is like the other.
    """
    area_ratio = float(np.median(np.linalg.det(warps))) if len(warps) else 1.0
    return 2 if area_ratio < MIN_AREA_RATIO else 1, 2 if area_ratio > 1.0 / MIN_AREA_RATIO else 1


def _reduced(grey: Grey, by: int) -> Grey:
    """Return an image whose sides are so many times shorter, up to pixels that are left over."""
    height, width = grey.shape[0] // by, grey.shape[1] // by
    return resized(grey[: by * height, : by * width], (width, height))


def _in_reduced(xy: Array, by: float) -> Array:
    """Return where pixels are in an image that was reduced."""
    return np.asarray((xy + 0.5) / by - 0.5)
