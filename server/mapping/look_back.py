"""Extends a new map backwards in time, over the frames that waited for it.

A map starts from the oldest frame that still shares tracks with the newest one. Of what earlier frames saw it
has little: posed by the few landmarks left in their sight they would err several times as much as later
frames, or get no pose. So from the start backwards frames become keyframes and their tracks landmarks, with
an adjustment after each.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.bundle_problem import assemble_problem
from semcast.server.mapping.kept_frames import Observed, keyframe_of, pose_of
from semcast.server.mapping.new_landmarks import triangulate_tracks
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.scene_depth import median_depth_of
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.window import within_limit

Array = NDArray[np.float64]

#: Keyframes from before a start at most.
_MAX_EARLIER = 10
#: Frames in a row without a pose, from which on the camera was somewhere else.
_MAX_MISSED = 15
#: Keyframes of one adjustment: there is one for each earlier keyframe, while the camera waits.
_WINDOW = 8
#: Steps of it.
_ITERATIONS = 5
#: A frame becomes a keyframe where it sees less than this share of the landmarks of the one after it,
_FEW_KNOWN_SHARE = 0.6
#: or where tracks have moved further than this share of the image's width.
_FAR_FLOW_SHARE = 0.1


def look_back(
    camera: Intrinsics,
    start: Start,
    history: Sequence[Observed],
    noise: NoiseModel,
    settings: ReconstructionSettings,
) -> Start:
    """Extend a start by frames from before it.

    Args:
        camera: Pinhole.
        start: A new map in its own frame.
        history: Frames that waited for it, in order of time; those before its first keyframe are looked at.
        noise: Of the observations.
        settings: Of the reconstruction.

    Returns:
        The start with earlier keyframes and what they see, the first of them at the origin, in the same unit.
    """
    extended = start
    guess, num_missed = start.keyframes[0].T_world_cam, 0
    before = [o for o in history if o.frame_id < start.keyframes[0].frame_id]
    for observed in reversed(before):
        T_world_cam = pose_of(camera, observed, extended.ids, extended.xyz, noise, guess, settings.seed)
        if T_world_cam is None:
            num_missed += 1
            if num_missed > _MAX_MISSED:
                break
            continue
        guess, num_missed = T_world_cam, 0
        if not _is_new_view(observed, extended, camera.width):
            continue
        keyframes = [keyframe_of(observed, T_world_cam), *extended.keyframes]
        extended = _with_new_points(camera, replace(extended, keyframes=keyframes), noise, settings)
        extended = _adjusted(camera, extended, noise)
        guess = extended.keyframes[0].T_world_cam
        if len(keyframes) == len(start.keyframes) + _MAX_EARLIER:
            break
    T_first_world = invert_transform(extended.keyframes[0].T_world_cam)
    return replace(
        extended,
        keyframes=[replace(k, T_world_cam=T_first_world @ k.T_world_cam) for k in extended.keyframes],
        xyz=transform_points(T_first_world, extended.xyz),
    )


def _is_new_view(observed: Observed, start: Start, width_px: int) -> bool:
    """Whether a frame sees enough else than the first keyframe to become one before it.

    Fewer of them than are made later on: each costs an adjustment at once.
    """
    first = start.keyframes[0]
    row, row_k = shared_rows(observed.ids, first.ids)
    flow_px = np.linalg.norm(observed.xy[row] - first.xy[row_k], axis=1)
    known, known_k = (np.isin(ids, start.ids, assume_unique=True).sum() for ids in (observed.ids, first.ids))
    if len(row) == 0 or known < _FEW_KNOWN_SHARE * known_k:
        return True
    return bool(np.median(flow_px) > _FAR_FLOW_SHARE * width_px)


def _with_new_points(
    camera: Intrinsics, start: Start, noise: NoiseModel, settings: ReconstructionSettings
) -> Start:
    """Add what the first keyframe saw together with others."""
    first = start.keyframes[0]
    wanted = first.ids[~np.isin(first.ids, start.ids, assume_unique=True)]
    depth = median_depth_of(first, start.ids, start.xyz)
    parallax_deg = settings.min_parallax_deg
    new = triangulate_tracks(camera, start.keyframes, first, wanted, noise, parallax_deg, depth)
    ids = np.concatenate([start.ids, new.ids])
    order = np.argsort(ids, kind="stable")
    return replace(
        start,
        ids=ids[order],
        xyz=np.concatenate([start.xyz, new.xyz])[order],
        confidence=np.concatenate([start.confidence, new.confidence])[order],
    )


def _adjusted(camera: Intrinsics, start: Start, noise: NoiseModel) -> Start:
    """Adjust the first keyframes and what they see; the last two of them hold the rest where it is."""
    window = start.keyframes[:_WINDOW]
    seen = gather_observations(window, start.ids)
    count = np.bincount(seen.point, minlength=len(start.ids))
    taken, kept, point = within_limit(start.ids, seen.point, -count)
    result = optimise(
        assemble_problem(
            camera,
            window,
            np.stack([k.T_world_cam for k in window]),
            start.ids[taken],
            start.xyz[taken],
            seen.of_rows(kept, point),
            noise,
            fixed=np.arange(len(window)) >= len(window) - 2,
            keep_baseline=False,
            iterations=_ITERATIONS,
        )
    )
    if not result.ok:
        return start
    xyz = start.xyz.copy()
    xyz[taken] = result.xyz
    adjusted = [replace(k, T_world_cam=T) for k, T in zip(window, result.T_world_cam, strict=True)]
    return replace(start, keyframes=[*adjusted, *start.keyframes[_WINDOW:]], xyz=xyz)
