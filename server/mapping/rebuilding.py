"""Builds the newest keyframes anew from their tracks, where the map has gone wrong (``contradiction``).

It is a start once more (``start_geometry``, ``ambiguity``, ``look_back``), of keyframes instead of frames.
The map competes with what is found: it too may only need to be let loose. The first keyframe stays where it
is, and the unit is that of the landmarks it saw: from before the map went wrong, or the least bent.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import interpolate_pose, invert_transform, make_transform, transform_points
from semcast.server.geometry.projection import depths_in
from semcast.server.geometry.weighting import NoiseModel, fuse_confidence
from semcast.server.mapping.adjustment import scales_around
from semcast.server.mapping.ambiguity import cost_of, decide
from semcast.server.mapping.contradiction import Contradiction
from semcast.server.mapping.hypotheses import problem_of
from semcast.server.mapping.kept_frames import Observed, pose_of
from semcast.server.mapping.keyframe_images import ImagedMap
from semcast.server.mapping.look_back import look_back
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.scene_motion import SceneMotion, motion_of_scene
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.start_alignment import aligned_views
from semcast.server.mapping.start_geometry import MIN_POINTS, Start, StartGeometry
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes that are built anew, at most.
_NUM_KEYFRAMES = 20
#: Tracks that the first view of what they show shares with the newest keyframe,
_MIN_SHARED = 60
#: and keyframes from one to the other, both counted, at least.
_MIN_SPAN = 3
#: How many times what fits best the map must cost.
_CLEAR_RATIO = 1.3
#: Landmarks of the first keyframes that tell the unit, at least.
_MIN_TELLING = 10
#: Those first keyframes.
_NUM_FIRST = 2


@dataclass(frozen=True)
class Rebuilt:
    """The newest keyframes of a map as they should be.

    Attributes:
        T_world_cam: Poses ``(4, 4)`` by frame id, ascending: of all keyframes since the first of them.
        ids: ``(P,)`` int64 points, ascending: tracks, landmarks of the map or not.
        xyz: ``(P, 3)`` world frame.
    """

    T_world_cam: dict[int, Array]
    ids: Ids
    xyz: Array


def put_straight(
    contradiction: Contradiction,
    mapped: ImagedMap,
    noise: NoiseModel,
    settings: ReconstructionSettings,
    *,
    settle: Callable[[], None],
) -> list[Keyframe]:
    """Build the newest keyframes of the current submap anew if their tracks contradict them.

    Args:
        contradiction: Tells that, once for each new keyframe.
        mapped: The map, which is changed.
        noise: Of observations.
        settings: Of the reconstruction.
        settle: Waits for an adjustment under way.

    Returns:
        The keyframes that were moved, in order of time; none where nothing fits clearly better.
    """
    if not contradiction.look(mapped.world, mapped.submap):
        return []
    settle()
    rebuilt = rebuild(mapped, noise, settings)
    contradiction.note(was_right=rebuilt is not None)
    if rebuilt is None:
        return []
    bring_in(mapped.world, rebuilt, mapped.submap)
    return [k for k in mapped.world.keyframes if k.frame_id in rebuilt.T_world_cam]


def rebuild(mapped: ImagedMap, noise: NoiseModel, settings: ReconstructionSettings) -> Rebuilt | None:
    """Build the newest keyframes of the current submap anew.

    Args:
        mapped: The map; it is not changed.
        noise: Of observations.
        settings: Of the reconstruction.

    Returns:
        None where nothing is found that fits clearly better than the map.
    """
    camera, world = mapped.camera, mapped.world
    greys = {image.frame_id: image.grey for image in mapped.images}
    newest = world.keyframes_of(mapped.submap)[-_NUM_KEYFRAMES:]
    history = [
        Observed(k.frame_id, k.t_source_ns, k.ids, k.xy, k.confidence, None, greys.get(k.frame_id), k.edge)
        for k in newest
    ]
    start = _better_start(camera, world, history, noise, settings)
    if start is None:
        return None
    return _in_world(
        camera, world, look_back(camera, start, history, noise, settings), newest, noise, settings
    )


def _better_start(
    camera: Intrinsics,
    world: WorldMap,
    history: Sequence[Observed],
    noise: NoiseModel,
    settings: ReconstructionSettings,
) -> Start | None:
    """What the newest keyframes show, if it fits them clearly better than the map does."""
    shared = [len(shared_rows(o.ids, history[-1].ids)[0]) for o in history]
    reference = next(k for k, num in enumerate(shared) if num >= _MIN_SHARED or k == len(history) - 1)
    span = list(history[reference:])
    if len(span) < _MIN_SPAN:
        return None
    scene, ids = _motion(camera, span[0], span[-1], noise, settings)
    if scene is None or scene.motion.is_rotation:
        return None
    geometry = StartGeometry(camera, settings.min_parallax_deg, settings.seed)
    poses = geometry.poses_between(span, scene, ids[scene.motion.inliers])
    if poses is None:
        return None
    at = sorted(poses)
    T_world_cam = np.stack([poses[k] for k in at])
    views = aligned_views(camera, [span[k] for k in at], T_world_cam)
    as_found = problem_of(views, T_world_cam, camera, scene.noise)
    T_mapped = np.stack([world.poses[o.frame_id] for o in views])
    as_mapped = problem_of(views, T_mapped, camera, scene.noise)
    if as_found is None or as_mapped is None:
        return None
    best, _ = decide(as_found, [(as_mapped, 0.0)], at_last=True)
    if best is None or not best.ok or _CLEAR_RATIO * best.cost > cost_of(as_mapped):
        return None
    T_cam_world = invert_transform(best.T_world_cam) @ best.T_world_cam[0]
    return geometry.start_of(views, T_cam_world, noise)


def _motion(
    camera: Intrinsics, first: Observed, last: Observed, noise: NoiseModel, settings: ReconstructionSettings
) -> tuple[SceneMotion | None, Ids]:
    """Motion from one view to another by their tracks alone, and the tracks."""
    row0, row1 = shared_rows(first.ids, last.ids)
    confidence = fuse_confidence(first.confidence[row0], last.confidence[row1])
    ids = first.ids[row0]
    if len(ids) < MIN_POINTS:
        return None, ids
    xy0, xy1 = first.xy[row0], last.xy[row1]
    mode, seed = settings.confidence, settings.seed
    return motion_of_scene(camera, xy0, xy1, confidence, noise, mode=mode, seed=seed), ids


def _in_world(
    camera: Intrinsics,
    world: WorldMap,
    start: Start,
    newest: Sequence[Keyframe],
    noise: NoiseModel,
    settings: ReconstructionSettings,
) -> Rebuilt | None:
    """Put a start where its first keyframe is in the map, in the map's unit, and pose those between."""
    first_id = start.keyframes[0].frame_id
    T_world_first = world.poses[first_id]
    scale = _unit(world, start, T_world_first)
    if scale is None:
        return None
    T_world_start = T_world_first @ invert_transform(start.keyframes[0].T_world_cam)
    xyz = transform_points(T_world_start, scale * start.xyz)
    poses: dict[int, Array] = {}
    for k in start.keyframes:
        poses[k.frame_id] = T_world_start @ make_transform(
            k.T_world_cam[:3, :3], scale * k.T_world_cam[:3, 3]
        )
    known = np.array(sorted(poses))
    for k in newest:
        if k.frame_id < first_id or k.frame_id in poses:
            continue
        after = int(np.searchsorted(known, k.frame_id))
        before_id, after_id = known[after - 1 : after + 1].tolist()
        share = (k.frame_id - before_id) / (after_id - before_id)
        guess = interpolate_pose(poses[before_id], poses[after_id], share)
        seen = Observed(k.frame_id, k.t_source_ns, k.ids, k.xy, k.confidence, edge=k.edge)
        T = pose_of(camera, seen, start.ids, xyz, noise, guess, settings.seed)
        poses[k.frame_id] = guess if T is None else T
    return Rebuilt({frame_id: poses[frame_id] for frame_id in sorted(poses)}, start.ids, xyz)


def _unit(world: WorldMap, start: Start, T_world_first: Array) -> float | None:
    """Units of the map in one of a start, by how far its first keyframes have what both know."""
    row = world.landmarks.rows(start.ids)
    seen_first = np.concatenate([k.ids for k in start.keyframes[:_NUM_FIRST]])
    both = np.flatnonzero((row >= 0) & np.isin(start.ids, seen_first))
    old = depths_in(invert_transform(T_world_first), world.landmarks.xyz[row[both]])
    new = depths_in(invert_transform(start.keyframes[0].T_world_cam), start.xyz[both])
    in_front = (old > 0.0) & (new > 0.0)
    if int(in_front.sum()) < _MIN_TELLING:
        return None
    return float(np.median(old[in_front] / new[in_front]))


def bring_in(world: WorldMap, rebuilt: Rebuilt, submap: int) -> None:
    """Bring it into the map it was made from: landmarks since its first keyframe that it does not know go."""
    moved = [k for k in world.keyframes_of(submap) if k.frame_id in rebuilt.T_world_cam]
    before = np.stack([k.T_world_cam for k in moved])
    after = np.stack([rebuilt.T_world_cam[k.frame_id] for k in moved])
    scale = scales_around(before, after, median_depth(world, moved[0])).tolist()
    frame_ids = [k.frame_id for k in moved]
    factor = dict(zip(frame_ids, scale, strict=True))
    for keyframe, T_world_cam in zip(moved, after, strict=True):
        world.move_keyframe(keyframe.frame_id, T_world_cam)
        keyframe.refuted = np.zeros(0, np.int64)
    mine = {k for k, part in world.submap_of.items() if part == submap and k > frame_ids[0]}
    for frame_id in mine - factor.keys():  # thinned out: they go with the one before them
        row = bisect_left(frame_ids, frame_id) - 1
        T_before_thinned = invert_transform(before[row]) @ world.poses[frame_id]
        T_before_thinned[:3, 3] *= scale[row]
        world.move_keyframe(frame_id, after[row] @ T_before_thinned)
        factor[frame_id] = scale[row]
    world.rescale_frames(factor)
    world.move_landmarks(rebuilt.ids, rebuilt.xyz)
    marks = world.landmarks
    is_mine = (marks.submap == submap) & (marks.born >= frame_ids[0])
    world.remove_landmarks(is_mine & ~np.isin(marks.ids, rebuilt.ids))
