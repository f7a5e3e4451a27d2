"""What the start of a map may be, kept from one attempt to the next.

While the first views fit several structures, a later attempt that looks for them anew may miss the one that
was right: its relative pose comes from fewer tracks, and mirroring leads to the others only roughly. So each
structure goes on: later frames are posed in it, and it competes again with all they have seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.triangulation import triangulate
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.ambiguity import Structure
from semcast.server.mapping.bundle_problem import BundleProblem, assemble_problem
from semcast.server.mapping.kept_frames import Observed, pose_of
from semcast.server.mapping.observations import gather_observations

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Points by which structures are told apart, at most: the longest tracks.
_MAX_DECIDING = 90
#: Steps of the adjustments that decide.
_DECIDING_ITERATIONS = 15
#: RMS error at most, in standard deviations, of a point by which further views are posed.
_MAX_ERROR_SIGMAS = 3.0


@dataclass(frozen=True)
class Hypothesis:
    """One structure the frames so far may show.

    Attributes:
        poses: Frame id -> ``T_world_cam (4, 4)``, in a frame and unit of its own.
        ids: ``(P,)`` int64 points, ascending.
        xyz: ``(P, 3)``.
        doubt: What attempts so far say against it, see ``Structure``.
    """

    poses: dict[int, Array]
    ids: Ids
    xyz: Array
    doubt: float


def hypothesis_of(
    structure: Structure, views: Sequence[Observed], camera: Intrinsics, noise: NoiseModel
) -> Hypothesis:
    """Return a structure with all points its views have seen, not only those that it was judged by.

    Args:
        structure: The structure, with a pose for each view.
        views: In order of time.
        camera: Pinhole.
        noise: Of the observations.
    """
    ids = np.unique(np.concatenate([o.ids for o in views]))
    view, point, xy, confidence, _ = gather_observations(views, ids)
    sigma = noise.sigma_px(confidence)
    points = triangulate(camera, invert_transform(structure.T_world_cam), view, point, xy, sigma, len(ids))
    seen = np.bincount(point, minlength=len(ids))
    good = points.in_front & (seen >= 2) & (points.error_sigma < _MAX_ERROR_SIGMAS)
    poses = {o.frame_id: T for o, T in zip(views, structure.T_world_cam, strict=True)}
    return Hypothesis(poses, ids[good], points.xyz[good], structure.doubt)


def poses_in(
    hypothesis: Hypothesis, views: Sequence[Observed], camera: Intrinsics, noise: NoiseModel, seed: int
) -> Array | None:
    """Poses of other views in a structure.

    Args:
        hypothesis: The structure.
        views: In order of time; some may have a pose in it.
        camera: Pinhole.
        noise: Of the observations.
        seed: Of the searches.

    Returns:
        ``T_world_cam (K, 4, 4)`` in the structure's own frame, None where one can't be posed.
    """
    frames = np.array(sorted(hypothesis.poses))
    poses: list[Array] = []
    for o in views:
        T_world_cam: Array | None = hypothesis.poses.get(o.frame_id)
        if T_world_cam is None:
            nearest = hypothesis.poses[int(frames[np.abs(frames - o.frame_id).argmin()])]
            guess = poses[-1] if poses else nearest
            T_world_cam = pose_of(camera, o, hypothesis.ids, hypothesis.xyz, noise, guess, seed)
        if T_world_cam is None:
            return None
        poses.append(T_world_cam)
    return np.stack(poses)


def problem_of(
    views: Sequence[Observed], T_world_cam: Array, camera: Intrinsics, noise: NoiseModel
) -> BundleProblem | None:
    """What some views saw of the longest tracks, begun with poses, to tell structures apart by its cost.

    Args:
        views: In order of time.
        T_world_cam: ``(K, 4, 4)`` of the views; the first is held.
        camera: Pinhole.
        noise: Of the observations.

    Returns:
        The problem, the same observations whatever the poses; None where these leave no point in front.
    """
    all_ids, count = np.unique(np.concatenate([o.ids for o in views]), return_counts=True)
    longest = np.lexsort((all_ids, -count))[:_MAX_DECIDING]
    ids = np.sort(all_ids[longest[count[longest] >= 2]])
    seen = gather_observations(views, ids)
    sigma = noise.sigma_px(seen.confidence)
    T_cam_world = invert_transform(T_world_cam)
    points = triangulate(camera, T_cam_world, seen.view, seen.point, seen.xy, sigma, len(ids))
    if not points.in_front.any():
        return None
    # A point that fits nowhere begins at a usual depth: the other structure may have a place for it.
    _, first = np.unique(seen.point, return_index=True)
    z = depths_in(T_cam_world[seen.view[first]], points.xyz)
    ray = camera.unproject(seen.xy[first]) * float(np.median(z[points.in_front]))
    T = T_world_cam[seen.view[first]]
    along = np.einsum("pij,pj->pi", T[:, :3, :3], ray) + T[:, :3, 3]
    return assemble_problem(
        camera,
        views,
        T_world_cam,
        ids,
        np.where(points.in_front[:, None], points.xyz, along),
        seen,
        noise,
        fixed=np.arange(len(views)) == 0,
        keep_baseline=True,
        iterations=_DECIDING_ITERATIONS,
    )
