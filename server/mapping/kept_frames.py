"""Frames kept from before there is a map, and their poses once there is one."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.edges import alike, each_of
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.pnp import refine_pose, search_pose
from semcast.server.geometry.sampling import sample_colours
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Landmarks that must agree with the pose of a kept frame.
_MIN_INLIERS = 15


@dataclass(frozen=True)
class Observed:
    """The tracks of one frame, the colours of their pixels, and its image where that is kept.

    Attributes:
        frame_id: Of the frame.
        t_source_ns: Of the frame.
        ids: ``(N,)`` int64, ascending.
        xy: ``(N, 2)`` pixels.
        confidence: ``(N,)`` of the positions.
        rgb: ``(N, 3)`` uint8, or None.
        grey: ``(H, W)`` uint8, or None.
        edge: ``(N, 2)`` of the positions, see ``edges``.
    """

    frame_id: int
    t_source_ns: int
    ids: Ids
    xy: Array
    confidence: Array
    rgb: NDArray[np.uint8] | None = None
    grey: Grey | None = None
    edge: Array = field(default_factory=alike)

    def __post_init__(self) -> None:
        """Have an edge for each observation."""
        object.__setattr__(self, "edge", each_of(self.edge, len(self.ids)))

    def without(self, ids: Ids) -> "Observed":
        """Return the same without some tracks."""
        kept = ~np.isin(self.ids, ids)
        rgb = None if self.rgb is None else self.rgb[kept]
        return replace(
            self,
            ids=self.ids[kept],
            xy=self.xy[kept],
            confidence=self.confidence[kept],
            rgb=rgb,
            edge=self.edge[kept],
        )


def observed_of(sight: Sight, tracks: TrackTable, rows: NDArray[np.bool_]) -> Observed:
    """Return some tracks of the newest image, with the image."""
    return Observed(
        sight.frame.frame_id,
        sight.frame.t_source_ns,
        tracks.ids[rows],
        tracks.xy[rows],
        tracks.confidence[rows],
        sample_colours(sight.frame.image, tracks.xy[rows]),
        sight.grey,
        tracks.edge[rows],
    )


def colours_of(ids: Ids, frames: Sequence[Observed]) -> NDArray[np.uint8]:
    """Return the ``(N, 3)`` colours of tracks ``ids`` (ascending) at their last sight, grey without one."""
    colours = np.full((len(ids), 3), 128, np.uint8)
    for observed in frames:
        if observed.rgb is not None:
            row, row_o = shared_rows(ids, observed.ids)
            colours[row] = observed.rgb[row_o]
    return colours


def keyframe_of(observed: Observed, T_world_cam: Array) -> Keyframe:
    """Return a kept frame as a keyframe of part 0, without descriptors."""
    return Keyframe(
        frame_id=observed.frame_id,
        t_source_ns=observed.t_source_ns,
        T_world_cam=T_world_cam,
        submap=0,
        ids=observed.ids,
        xy=observed.xy,
        confidence=observed.confidence,
        edge=observed.edge,
    )


def pose_of(
    camera: Intrinsics,
    observed: Observed,
    ids: Ids,
    xyz: Array,
    noise: NoiseModel,
    T_world_guess: Array,
    seed: int,
) -> Array | None:
    """Pose of a kept frame from landmarks.

    Args:
        camera: Pinhole.
        observed: The frame.
        ids: ``(P,)`` landmarks, ascending.
        xyz: ``(P, 3)`` world frame.
        noise: Of the observations.
        T_world_guess: ``(4, 4)`` pose to begin with; where fewer than half agree, it is searched for without.
        seed: Of the search.

    Returns:
        ``T_world_cam (4, 4)``, None where too few agree.
    """
    row, row_o = shared_rows(ids, observed.ids)
    if len(row) < _MIN_INLIERS:
        return None
    sigma = noise.sigma_px(observed.confidence[row_o])
    gate = noise.threshold_px(observed.confidence[row_o])
    T_cam_world, edge = invert_transform(T_world_guess), observed.edge[row_o]
    estimate = refine_pose(camera, T_cam_world, xyz[row], observed.xy[row_o], sigma, gate, edge=edge)
    if estimate.num_inliers < 0.5 * len(row):
        searched = search_pose(
            camera, xyz[row], observed.xy[row_o], sigma, gate, seed=seed, min_inliers=_MIN_INLIERS, edge=edge
        )
        if searched is not None and searched.num_inliers > estimate.num_inliers:
            estimate = searched
    if estimate.num_inliers < _MIN_INLIERS:
        return None
    return invert_transform(estimate.T_cam_world)


def backfill(
    camera: Intrinsics,
    world: WorldMap,
    keyframes: Sequence[Keyframe],
    kept: Sequence[Observed],
    noise: NoiseModel,
    seed: int,
) -> tuple[tuple[int, int, Array], ...]:
    """Pose frames of the past in a map, from the newest backwards, and add them to it.

    Args:
        camera: Pinhole.
        world: The map; some of the frames may have a pose in it.
        keyframes: Those the poses hang on, in order of time, the last one not before any of the frames; each
            frame moves with the next one after it.
        kept: The frames, in order of time.
        noise: Of the observations.
        seed: Of the searches.

    Returns:
        ``(frame_id, t_source_ns, T_world_cam)`` of those that have a pose now, in order of time.
    """
    keyframe_ids = np.array([k.frame_id for k in keyframes])
    guess = keyframes[-1].T_world_cam
    posed = []
    for observed in reversed(kept):
        T_world_cam: Array | None
        if observed.frame_id in world.frames:
            T_world_cam = world.pose_of_frame(observed.frame_id)
        else:
            T_world_cam = pose_of(
                camera, observed, world.landmarks.ids, world.landmarks.xyz, noise, guess, seed
            )
            if T_world_cam is not None:
                after = keyframe_ids[np.searchsorted(keyframe_ids, observed.frame_id)]
                world.add_frame(observed.frame_id, int(after), T_world_cam)
        if T_world_cam is not None:
            guess = T_world_cam
            posed.append((observed.frame_id, observed.t_source_ns, T_world_cam))
    return tuple(reversed(posed))
