"""The adjustment of all keyframes at once, when a stream has ended and nothing waits for a pose.

A window corrects what its own keyframes see. That a place seen again is where it was, and that an error of
the start was bent into all that came after, takes all observations of the map together.
"""

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.bundle_problem import assemble_problem
from semcast.server.mapping.mapper import drop_outliers, gather_observations, local_scales
from semcast.server.mapping.window import within_limit
from semcast.server.mapping.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Observations at most, for a stream to end within seconds: those of a hundred to two hundred keyframes; and
#: where there are more keyframes than by default, so many each, for with fewer they go astray.
MAX_OBSERVATIONS, OBSERVATIONS_EACH = 60_000, 200
#: Keyframes at most: so many take ten seconds, and several times as many minutes and gigabytes.
MAX_KEYFRAMES = 1000
#: Below that many keyframes a window held them all, most of the time.
_MIN_KEYFRAMES = 5
#: Landmarks a keyframe shares at least with those it hangs together with: fewer don't say where it is.
_MIN_SHARED = 12
#: The second time without what the first one found to be outliers.
_ROUNDS, _ITERATIONS = 2, 15


def adjust_whole_map(world: WorldMap, camera: Intrinsics, noise: NoiseModel) -> int:
    """Adjust every keyframe with all it sees, part by part of what hangs together.

    A part's first keyframe stays, and so does the distance to the one furthest from it. What no adjustment
    holds (landmarks left out, frames that are no keyframes, keyframes that were thinned out) follows the
    keyframe before it, in its scale. A submap of more than ``MAX_KEYFRAMES`` stays.

    Args:
        world: The map, which is changed where an adjustment succeeds.
        camera: Pinhole.
        noise: Gives each observation its sigma.

    Returns:
        Number of keyframes that were adjusted.
    """
    num_adjusted = 0
    for submap in sorted({k.submap for k in world.keyframes}):
        mine, settled = world.keyframes_of(submap), list[Keyframe]()
        if len(mine) > MAX_KEYFRAMES:
            logger.info("a map of %d keyframes is too large to be adjusted as a whole", len(mine))
            continue
        for part in _hanging_together(world, mine):
            if len(part) < _MIN_KEYFRAMES:
                continue
            num_rounds = 0
            while num_rounds < _ROUNDS and _adjust(world, part, settled, camera, noise):
                num_rounds += 1
            if num_rounds:
                settled += part
        num_adjusted += len(settled)
    return num_adjusted


def _hanging_together(world: WorldMap, keyframes: Sequence[Keyframe]) -> list[list[Keyframe]]:
    """Sort keyframes into parts that share landmarks; each part, and the parts, in order of time.

    Parts that share none can't be adjusted together: nothing would hold one's place and scale to the other's.
    """
    parts: list[tuple[list[Keyframe], set[int]]] = []
    for keyframe in keyframes:
        seen = set(keyframe.ids[world.landmarks.rows(keyframe.ids) >= 0].tolist())
        linked = [part for part in parts if len(part[1] & seen) >= _MIN_SHARED]
        parts = [part for part in parts if len(part[1] & seen) < _MIN_SHARED]
        members = [k for part, _ in linked for k in part]
        parts.append(([*members, keyframe], seen.union(*(ids for _, ids in linked))))
    ordered = [sorted(part, key=lambda k: k.frame_id) for part, _ in parts]
    return sorted(ordered, key=lambda part: part[0].frame_id)


def _adjust(
    world: WorldMap, part: list[Keyframe], settled: list[Keyframe], camera: Intrinsics, noise: NoiseModel
) -> bool:
    """Adjust one part and drop what does not fit it; whether that succeeded.

    Keyframes of parts that are ``settled`` stay, those between and after this part's ones too.
    """
    ids = np.unique(np.concatenate([k.ids for k in part]))
    ids = ids[world.landmarks.rows(ids) >= 0]
    seen = gather_observations(part, ids)
    limit = max(MAX_OBSERVATIONS, OBSERVATIONS_EACH * len(part))
    taken, kept, point = within_limit(ids, seen.point, limit=limit)
    landmark_ids = ids[taken]
    result = optimise(
        assemble_problem(
            camera,
            part,
            np.stack([k.T_world_cam for k in part]),
            landmark_ids,
            world.landmarks.xyz[world.landmarks.rows(landmark_ids)].copy(),
            seen.of_rows(kept, point),
            noise,
            fixed=np.arange(len(part)) == 0,
            keep_baseline=True,
            iterations=_ITERATIONS,
        )
    )
    if not result.ok:
        logger.debug("the map of %d keyframes can't be adjusted as a whole", len(part))
        return False
    problem = result.problem
    frame_ids = np.array([k.frame_id for k in (*part, *settled)], dtype=np.int64)
    T_world_cam = np.stack([*result.T_world_cam, *(k.T_world_cam for k in settled)])
    scale = np.concatenate([local_scales(result), np.ones(len(settled))])
    order = np.argsort(frame_ids)
    world.bend(frame_ids[order], T_world_cam[order], scale[order])
    world.move_landmarks(problem.landmark_ids, result.xyz)
    drop_outliers(world, result, noise)
    return True
