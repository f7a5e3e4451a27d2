"""What a map begins with once two views and their relative pose are known: the frames between, and points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import interpolate_pose, invert_transform
from semcast.server.geometry.triangulation import Triangulation, triangulate
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.kept_frames import Observed, keyframe_of, pose_of
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.scene_motion import SceneMotion
from semcast.server.mapping.world_map import Keyframe

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes of a new map at most.
START_KEYFRAMES = 5
#: Points of a new map at least.
MIN_POINTS = 40
#: Least angle between the rays of a point of a start, as a share of the one that is asked for later: its
#: views are near each other.
_PARALLAX_SHARE = 0.5
#: RMS error of such a point at most, in standard deviations. It is larger than a landmark's may be
#: (``new_landmarks.MAX_ERROR_SIGMA``), as a start is adjusted at once.
_MAX_ERROR_SIGMA = 2.5


@dataclass(frozen=True)
class Start:
    """A new map in its own frame: the first keyframe at the origin, median depth about 1.

    Attributes:
        keyframes: In order of time, without descriptors.
        ids: ``(P,)`` int64 landmarks.
        xyz: ``(P, 3)``.
        confidence: ``(P,)`` mean over observations.
    """

    keyframes: list[Keyframe]
    ids: Ids
    xyz: Array
    confidence: Array


class StartGeometry:
    """Places frames between two views and triangulates what all of them saw.

    Args:
        camera: Pinhole.
        min_parallax_deg: From which a point is triangulated in a map; at its start, half of it will do.
        seed: Of the searches.
    """

    def __init__(self, camera: Intrinsics, min_parallax_deg: float, seed: int) -> None:
        self._camera = camera
        self._min_parallax_deg = min_parallax_deg
        self._seed = seed

    def poses_between(self, span: list[Observed], scene: SceneMotion, ids: Ids) -> dict[int, Array] | None:
        """Poses of the ends and of frames between, by place in the span; None where nothing has depth."""
        T_last_first, last = scene.motion.T_cam1_cam0, len(span) - 1
        T_world_cam = {0: np.eye(4), last: invert_transform(T_last_first)}
        ends = np.stack([np.eye(4), T_last_first])
        points = self._triangulate([span[0], span[-1]], ends, ids, scene.noise)
        good = self._passes(points)
        if int(good.sum()) < MIN_POINTS:
            return None
        known = ids[good], points.xyz[good]
        for k in _between(span):
            guess = interpolate_pose(T_world_cam[0], T_world_cam[last], k / last)
            T_world_inner = pose_of(self._camera, span[k], *known, scene.noise, guess, self._seed)
            if T_world_inner is not None:
                T_world_cam[k] = T_world_inner
        return T_world_cam

    def start_of(self, views: list[Observed], T_cam_world: Array, noise: NoiseModel) -> Start | None:
        """Triangulate all tracks of posed views; None where too few of them have a depth."""
        all_ids = np.unique(np.concatenate([o.ids for o in views]))
        points = self._triangulate(views, T_cam_world, all_ids, noise)
        good = self._passes(points)
        if int(good.sum()) < MIN_POINTS:
            return None
        scale = 1.0 / float(np.median(points.xyz[good, 2]))
        if not 0 < scale < np.inf:
            return None
        keyframes = []
        for o, T in zip(views, invert_transform(T_cam_world), strict=True):
            T[:3, 3] *= scale
            keyframes.append(keyframe_of(o, T))
        _, point, _, confidence, _ = gather_observations(views, all_ids[good])
        mean = np.bincount(point, weights=confidence) / np.bincount(point)
        return Start(keyframes, all_ids[good], scale * points.xyz[good], mean)

    def _triangulate(
        self, frames: list[Observed], T_cam_world: Array, ids: Ids, noise: NoiseModel
    ) -> Triangulation:
        view, point, xy, confidence, _ = gather_observations(frames, ids)
        sigma = noise.sigma_px(confidence)
        return triangulate(self._camera, T_cam_world, view, point, xy, sigma, len(ids))

    def _passes(self, points: Triangulation) -> NDArray[np.bool_]:
        return (
            points.in_front
            & (points.parallax_deg > _PARALLAX_SHARE * self._min_parallax_deg)
            & (points.error_sigma < _MAX_ERROR_SIGMA)
        )


def _between(span: list[Observed]) -> list[int]:
    """Which frames between the first and the last become keyframes: spread out, with an image if one has."""
    inner = [k for k in range(1, len(span) - 1) if span[k].grey is not None] or [*range(1, len(span) - 1)]
    if not inner:
        return []
    wanted = np.linspace(0, len(span) - 1, START_KEYFRAMES)[1:-1]
    return sorted({min(inner, key=lambda k: abs(k - w)) for w in wanted.tolist()})
