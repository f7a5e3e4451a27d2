"""Where am I after a gap? SIFT against the newest keyframes, then their landmarks by warped patches.

Binary descriptors of upright corners recognise a place from nearly where it was seen. A camera that went on
for a second sees it turned and from elsewhere: a handful of matches with any one keyframe are right, but all
keyframes are of one map, and what is right of all their matches agrees on one pose. What looks as it did
there, once pose and depth have warped it, proves the place, and says to a fraction of a pixel where each
landmark is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.common.image import resized
from semcast.server.geometry.corners import deduplicate
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.patch_alignment import (
    ANCHOR_PATCH_PX,
    MIN_AREA_RATIO,
    Templates,
    affine_warps,
    align_patches,
    seen_alike,
)
from semcast.server.geometry.pnp import PoseEstimate, refine_pose, search_pose
from semcast.server.geometry.square_distance import square_distances
from semcast.server.geometry.weighting import GATE_SIGMAS, NoiseModel
from semcast.server.geometry.wide_search import WideFeatures, match_near, match_wide
from semcast.server.mapping.keyframe_images import KeyframeImages, SeenFrom
from semcast.server.mapping.relocalisation import Place
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes that are looked at, the newest ones.
_NUM_KEYFRAMES = 5
#: Frames after which a camera that was not found with them is somewhere else: a look takes as long as
#: everything else of a frame.
_MAX_FRAMES = 8
#: Ratio of distances up to which a nearest descriptor counts: landmarks tell wrong matches surely.
_MAX_RATIO = 0.85
#: A landmark must be this near to a match to go where the match goes,
_MAX_OFFSET_PX = 15.0
#: and its place is then good to this standard deviation.
_CARRIED_SIGMA_PX = 2.5
#: Landmarks that must agree with a pose, each in a place of its own: keyframes that see the same thing make
#: the same wrong match. Images of other recordings had six at most.
_MIN_FIRST = 8
#: Hypotheses of a search: where one match of seven is right, 343 have one that rests on right ones alone.
_SEARCH_ITERATIONS = 2000
#: Share of a keyframe's landmarks that must look as they did where the pose has them, one for each round of
#: looking: the first pose is a rough one.
_LEAST_SHARES = (0.0, 0.0, 0.2)
#: So many times smaller are the images in those rounds, for a pose by matches, which is a degree or two off,
_MATCHED_COARSE = (2, 1, 1)
#: and for one that is expected only.
_EXPECTED_COARSE = (4, 2, 1)
#: Share of those that must agree with the pose of the next round.
_MIN_AGREEING_SHARE = 0.5
_ALIGNED_SIGMA_PX = 1.0
#: A landmark is looked for no nearer to the border: its patch is whole.
_MARGIN_PX = ANCHOR_PATCH_PX // 2
#: How far what a guess expects may be from there in the image.
_REACH_PX = 60.0


@dataclass(frozen=True)
class _View:
    """A keyframe and the landmarks it saw.

    Attributes:
        keyframe: Itself.
        image: Its image.
        ids: ``(N,)`` landmarks.
        xy: ``(N, 2)`` where it saw them.
        xyz: ``(N, 3)`` where they are.
    """

    keyframe: Keyframe
    image: SeenFrom
    ids: Ids
    xy: Array
    xyz: Array

    @staticmethod
    def of(image: SeenFrom, keyframe: Keyframe, world: WorldMap) -> "_View":
        """Gather what a keyframe saw of the map."""
        row = world.landmarks.rows(keyframe.ids)
        known = row >= 0
        return _View(
            keyframe, image, keyframe.ids[known], keyframe.xy[known], world.landmarks.xyz[row[known]]
        )


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
        self._known: list[tuple[SeenFrom, WideFeatures]] = []
        self._looked_for: tuple[int, int] = (-1, 0)

    def find(
        self,
        sight: Sight,
        world: WorldMap,
        images: KeyframeImages,
        noise: NoiseModel,
        T_world_guess: Array | None = None,
    ) -> Place | None:
        """Look for the place of an image among the newest keyframes, in the first frames after the newest.

        Args:
            sight: The image.
            world: The map.
            images: Of keyframes.
            noise: Of observations.
            T_world_guess: Where the camera's motion leads, where that is known.
        """
        views = _newest_views(world, images)
        if not views:
            return None
        last_id, num_looked = self._looked_for
        newest_id = views[0].keyframe.frame_id
        num_looked = num_looked if newest_id == last_id else 0
        if num_looked == _MAX_FRAMES:
            return None
        self._looked_for = newest_id, num_looked + 1
        self._known = [(image, known) for image, known in self._known if any(image is v.image for v in views)]
        guesses = [None] if T_world_guess is None else [invert_transform(T_world_guess), None]
        for T_cam_world in guesses:
            searched = self._search(sight, views, noise, T_cam_world)
            if searched is None:
                continue
            place = self._look(sight, views, searched.T_cam_world, noise, _MATCHED_COARSE)
            if place is not None:
                return place
        return None

    def look(
        self, sight: Sight, world: WorldMap, images: KeyframeImages, noise: NoiseModel, T_world_cam: Array
    ) -> Place | None:
        """Look for the place of an image at an expected pose only, by patches that need no match.

        Args:
            sight: The image.
            world: The map.
            images: Of keyframes.
            noise: Of observations.
            T_world_cam: The pose, turned to a degree and as near as things move by some ten pixels.
        """
        views = _newest_views(world, images)
        return self._look(sight, views, invert_transform(T_world_cam), noise, _EXPECTED_COARSE)

    def _look(
        self, sight: Sight, views: list[_View], T_cam_world: Array, noise: NoiseModel, coarse: Sequence[int]
    ) -> Place | None:
        """Look at a pose for what one of the views saw."""
        for view in views:
            found = self._proved(sight, view, T_cam_world, noise, coarse)
            if found is not None:
                return self._place(sight, view, views, found, noise)
        return None

    def _features_of(self, image: SeenFrom) -> WideFeatures:
        """Features of a keyframe, kept as long as its image is neither old nor replaced."""
        known = next((features for kept, features in self._known if kept is image), None)
        if known is None:
            known = WideFeatures.of(image.grey)
            self._known.append((image, known))
        return known

    def _search(
        self, sight: Sight, views: list[_View], noise: NoiseModel, T_cam_world: Array | None
    ) -> PoseEstimate | None:
        """Rough pose, by landmarks next to matches of any view: those near where a guess has them, or all.

        Of views in another part of the map, matches agree with no pose of this one: they are wrong ones.
        """
        there, here = zip(*(self._matched(sight, view, T_cam_world) for view in views), strict=True)
        xyz, xy = np.concatenate(there), np.concatenate(here)
        sigma = np.full(len(xyz), max(_CARRIED_SIGMA_PX, noise.sigma0_px))
        found = search_pose(
            self._camera,
            xyz,
            xy,
            sigma,
            GATE_SIGMAS * sigma,
            seed=self._seed,
            min_inliers=_MIN_FIRST,
            max_iterations=_SEARCH_ITERATIONS,
        )
        if found is None or deduplicate(xy[found.inliers], _MAX_OFFSET_PX).sum() < _MIN_FIRST:
            return None
        return found

    def _matched(self, sight: Sight, view: _View, T_cam_world: Array | None) -> tuple[Array, Array]:
        """Landmarks ``(K, 3)`` of a view that are next to matches, and where these take them, ``(K, 2)``."""
        features, here = self._features_of(view.image), sight.wide_features
        if T_cam_world is None:
            matches = match_wide(features, here, _MAX_RATIO)
        else:
            expected = self._expected(view, features.xy, T_cam_world)
            matches = match_near(features, here, expected, _REACH_PX, _MAX_RATIO)
        rows, carried = matches.carry(view.xy, _MAX_OFFSET_PX)
        return view.xyz[rows], carried

    def _expected(self, view: _View, xy: Array, T_cam_world: Array) -> Array:
        """Return where a pose has pixels ``(N, 2)`` of a keyframe, as deep as the landmarks next to them."""
        xyz = transform_points(invert_transform(view.keyframe.T_world_cam), view.xyz)
        depth = xyz[square_distances(xy, view.xy).argmin(axis=1), 2]
        points = transform_points(view.keyframe.T_world_cam, depth[:, None] * self._camera.unproject(xy))
        return self._camera.project(transform_points(T_cam_world, points))

    def _proved(
        self, sight: Sight, view: _View, T_cam_world: Array, noise: NoiseModel, coarse: Sequence[int]
    ) -> PoseEstimate | None:
        """Pose of landmarks that look as a keyframe saw them, None where those are too few."""
        found = None
        for least_share, by in zip(_LEAST_SHARES, coarse, strict=True):
            aligned = self._aligned(sight, view, T_cam_world, by)
            if len(aligned.ids) < max(_MIN_FIRST, least_share * aligned.num_looked_for):
                return None
            found = self._refined(T_cam_world, aligned.xyz, aligned.xy, noise, by)
            if found.num_inliers < max(_MIN_FIRST, _MIN_AGREEING_SHARE * len(aligned.ids)):
                return None
            T_cam_world = found.T_cam_world
        return found

    def _place(
        self, sight: Sight, proved: _View, views: list[_View], found: PoseEstimate, noise: NoiseModel
    ) -> Place:
        """Look for the landmarks of all views: a pose from far off rests on few of any single one.

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
        pose = self._refined(found.T_cam_world, xyz, xy, noise)
        good, keyframe = pose.inliers, proved.keyframe
        T_world_cam = invert_transform(pose.T_cam_world)
        proof = replace(pose, inliers=good[good], residual_px=pose.residual_px[good])
        return Place(T_world_cam, keyframe.frame_id, ids[good], xy[good], keyframe.submap, proof)

    def _aligned(self, sight: Sight, view: _View, T_cam_world: Array, by: int = 1) -> _Aligned:
        """Look for all landmarks of a keyframe where a pose has them, in images reduced by a factor."""
        depth0 = transform_points(invert_transform(view.keyframe.T_world_cam), view.xyz)[:, 2]
        expected = self._camera.project(transform_points(T_cam_world, view.xyz))
        rows = np.flatnonzero(sight.shows(expected, _MARGIN_PX) & (depth0 > 0.0))
        T_cam_keyframe = T_cam_world @ view.keyframe.T_world_cam
        warps, depth1 = affine_warps(self._camera, T_cam_keyframe, view.xy[rows], depth0[rows])
        there, here = (by * reduction for reduction in _reductions(warps))
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

    def _refined(
        self, T_cam_world: Array, xyz: Array, xy: Array, noise: NoiseModel, by: int = 1
    ) -> PoseEstimate:
        """Pose of landmarks that were found, in images reduced by a factor."""
        sigma = np.full(len(xyz), by * max(_ALIGNED_SIGMA_PX, noise.sigma0_px))
        return refine_pose(self._camera, T_cam_world, xyz, xy, sigma, GATE_SIGMAS * sigma)


def _newest_views(world: WorldMap, images: KeyframeImages) -> list[_View]:
    """What the newest keyframes with an image saw that still see landmarks, newest first."""
    there = [(image, world.keyframe(image.frame_id)) for image in images.newest(_NUM_KEYFRAMES)]
    views = [_View.of(image, keyframe, world) for image, keyframe in reversed(there) if keyframe is not None]
    return [view for view in views if len(view.ids)]


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
