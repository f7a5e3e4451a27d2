"""Depth maps of a recording's keyframes, from whatever images of them arrived."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.evaluation.pipeline import LinkedFrame
from semcast.evaluation.reconstruct import as_received
from semcast.server.dense.consistency import OtherDepth, added_points, confirmed_by
from semcast.server.dense.depth_map import DepthMap, DepthProblem, estimate_depth
from semcast.server.dense.neighbours import (
    NUM_COVERING,
    DepthRange,
    confirming,
    depth_problem,
    depth_range,
)
from semcast.server.dense.view import View
from semcast.server.geometry.projection import depths_in
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthKeyframe:
    """Where a keyframe was and between which depths there is something.

    Attributes:
        T_world_cam: ``(4, 4)`` pose.
        sought: Depths, units of the poses.
    """

    T_world_cam: Array
    sought: DepthRange

    def with_poses_of(self, T_world_cam: Array, scale: float) -> "DepthKeyframe":
        """Return it at another pose, in whose units one of its own is ``scale``."""
        return DepthKeyframe(T_world_cam, DepthRange(*(scale * depth for depth in self.sought)))


def reconstructed(
    frames: Iterable[LinkedFrame], camera: Intrinsics, settings: ReconstructionSettings
) -> tuple[dict[int, Array], dict[int, DepthKeyframe]]:
    """Reconstruct frames; return poses, and those keyframes whose landmarks tell a range of depths.

    Args:
        frames: In order.
        camera: Of their images.
        settings: How to reconstruct.

    Returns:
        Frame id to ``T_world_cam``, and keyframe id to where it was, of the largest part of the map.
    """
    reconstruction = Reconstruction(camera, settings, InlineBundle())
    try:
        for frame in frames:
            if frame.decoded is not None:
                reconstruction.process(as_received(frame))
        reconstruction.conclude()
        poses = reconstruction.final_trajectory()
        ids, xyz, _, _ = reconstruction.landmarks()
        seen_ids, seen_by, _ = reconstruction.world.observations()
        part_of = reconstruction.world.part_of_frames()
    finally:
        reconstruction.close()
    largest, _ = Counter(part_of.values()).most_common(1)[0] if part_of else (0, 0)
    poses = {k: T_world_cam for k, T_world_cam in poses.items() if part_of.get(k) == largest}
    place = dict(zip(ids.tolist(), xyz, strict=True))
    keyframes = {}
    for k in sorted({*seen_by.tolist()} & {*poses}):
        points = np.array([place[i] for i in seen_ids[seen_by == k].tolist() if i in place]).reshape(-1, 3)
        depth = depths_in(invert_transform(poses[k]), points)
        sought = depth_range(depth[depth > 0.0])
        if sought is not None:
            keyframes[k] = DepthKeyframe(poses[k], sought)
    return poses, keyframes


def confirmed_depths(
    keyframes: Mapping[int, DepthKeyframe], views: Mapping[int, View]
) -> dict[int, DepthMap]:
    """Estimate the depth of keyframes from their views and keep what others confirm.

    Args:
        keyframes: By frame id.
        views: Of those that arrived.

    Returns:
        Inverse depth in units of the poses, NaN where it is not confirmed, of every keyframe that has a view
        and a neighbour.
    """
    problems = {k: _problem(k, keyframes, views) for k in sorted(views)}
    maps = {k: estimate_depth(problem) for k, problem in problems.items() if problem is not None}
    confirmed = {}
    for k, found in maps.items():
        others = _seen_from(k, [maps[j] for j in confirming(maps, k)], keyframes, views)
        confirmed[k] = confirmed_by(found, views[k].K, others)
    return confirmed


def cloud_points(
    confirmed: Mapping[int, DepthMap], keyframes: Mapping[int, DepthKeyframe], views: Mapping[int, View]
) -> dict[int, NDArray[np.float32]]:
    """Return what each keyframe adds to the dense cloud, ``(N, 3)`` in its camera frame, units of the poses.

    Args:
        confirmed: Of ``confirmed_depths``.
        keyframes: By frame id.
        views: Those that ``confirmed`` is from.
    """
    added, order = {}, sorted(confirmed)
    for place, k in enumerate(order):
        covering = [confirmed[j] for j in order[max(0, place - NUM_COVERING) : place]]
        covering_here = _seen_from(k, covering, keyframes, views)
        added[k], _ = added_points(confirmed[k], views[k].K, covering_here)
    return added


def _problem(
    k: int, keyframes: Mapping[int, DepthKeyframe], views: Mapping[int, View]
) -> DepthProblem | None:
    sides = (sorted((j for j in views if j < k), reverse=True), sorted(j for j in views if j > k))
    posed = [((views[j], keyframes[j].T_world_cam) for j in side) for side in sides]
    return depth_problem(views[k], keyframes[k].T_world_cam, keyframes[k].sought, posed)


def _seen_from(
    k: int,
    maps: Iterable[DepthMap],
    keyframes: Mapping[int, DepthKeyframe],
    views: Mapping[int, View],
) -> list[OtherDepth]:
    """Other keyframes' depth as ``consistency`` takes it."""
    T_world_cam = keyframes[k].T_world_cam
    return [
        OtherDepth(
            found.inverse_depth,
            found.step,
            views[found.frame_id].K,
            invert_transform(keyframes[found.frame_id].T_world_cam) @ T_world_cam,
        )
        for found in maps
    ]
