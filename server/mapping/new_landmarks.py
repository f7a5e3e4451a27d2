"""New landmarks: tracks that keyframes saw from far enough apart, triangulated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.sampling import sample_colours
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.refuted import with_neighbours
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: The newest keyframes whose observations are used.
_NUM_KEYFRAMES = 12
#: Root mean square error of a triangulated landmark at most, in standard deviations.
MAX_ERROR_SIGMA = 1.8
#: RMS error in standard deviations from which on a track seen at least twice is no point at rest: it slipped,
#: or is on something that moves by itself.
_REFUTED_SIGMA = 4.0
#: Landmarks further than this many median depths are as good as at infinity.
_MAX_DEPTH_RATIO = 60.0
#: Where landmarks run out, points with less parallax are accepted, down to this share of the usual angle: a
#: camera that turns leaves all it knows, and sees hardly anything from two sides.
_LEAST_PARALLAX_SHARE = 0.3


def add_landmarks(
    world: WorldMap,
    camera: Intrinsics,
    noise: NoiseModel,
    image: NDArray[np.uint8],
    min_parallax_deg: float,
    *,
    enough: int = 0,
) -> int:
    """Triangulate the tracks of the newest keyframe that are no landmarks yet; returns the number added.

    Args:
        world: The map, grown.
        camera: Pinhole.
        noise: Of the observations.
        image: The newest keyframe's, ``(H, W, 3)``, for the colours.
        min_parallax_deg: Angle between the rays of a point.
        enough: With fewer landmarks in sight than this, smaller angles are accepted.
    """
    newest = world.keyframes[-1]
    is_new = world.landmarks.rows(newest.ids) < 0
    wanted = newest.ids[is_new]
    num_known = len(newest.ids) - len(wanted)
    if num_known < enough:
        min_parallax_deg *= max(num_known / enough, _LEAST_PARALLAX_SHARE)
    views = [k for k in world.keyframes[-_NUM_KEYFRAMES:] if k.submap == newest.submap]
    reach = median_depth(world, newest)
    new = triangulate_tracks(camera, views, newest, wanted, noise, min_parallax_deg, reach)
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


def triangulate_tracks(
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
