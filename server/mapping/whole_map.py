"""The adjustment of all keyframes at once, when a stream has ended and nothing waits for a pose.

A window corrects what its own keyframes see. That a place seen again is where it was, and that an error of
the start was bent into all that came after, takes all observations of the map together.

Where keyframes were thinned out, those that are left share landmarks two by two, and hardly any that three of
them see. Two views tell where the camera went, but not how far: nothing would hold the length of one step to
that of the next. What the keyframes between them told is in how far they are apart, and is taken as known.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.adjustment import drop_outliers, local_scales
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.bundle_problem import assemble_problem
from semcast.server.mapping.observations import gather_observations
from semcast.server.mapping.pose_graph import PoseConstraint
from semcast.server.mapping.steps import steps_of
from semcast.server.mapping.window import within_limit
from semcast.server.mapping.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Observations of one adjustment at most, for a stream to end within seconds: those of a hundred to two
#: hundred keyframes.
MAX_OBSERVATIONS = 60_000
#: Observations for each keyframe where there are more keyframes than by default: with fewer they go astray.
OBSERVATIONS_EACH = 200
#: Keyframes at most: so many take ten seconds, and several times as many minutes and gigabytes.
MAX_KEYFRAMES = 1000
#: A map of fewer keyframes is left as it is: a window held them all, most of the time.
_MIN_KEYFRAMES = 5
#: Landmarks that connect a keyframe to its part of the map, at least: fewer don't say where it is.
_MIN_SHARED = 12
#: Drift that a loop has to be shared out by is meant large, the same everywhere. What tracking really errs by
#: on a step is less, a tenth to a third of it, over clean images and over fading.
_SHARE_OF_DRIFT = 0.3
#: Adjustments, the second one without what the first one found to be outliers.
_ROUNDS = 2
#: Steps of each.
_ITERATIONS = 15


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
            # Not earlier: a part before this one may have changed its unit.
            steps, num_rounds = _steps_within(_known_steps(world, mine), mine, part), 0
            while num_rounds < _ROUNDS and _adjust(world, part, steps, settled, camera, noise):
                num_rounds += 1
            if num_rounds:
                settled += part
        num_adjusted += len(settled)
    return num_adjusted


def _known_steps(world: WorldMap, keyframes: Sequence[Keyframe]) -> dict[int, PoseConstraint]:
    """Row of a keyframe -> the step to it, where keyframes were thinned out before it."""
    return {
        s.constraint.second: s.constraint for s in steps_of(world, keyframes) if s.is_thinned and not s.is_gap
    }


def _hanging_together(world: WorldMap, keyframes: Sequence[Keyframe]) -> list[list[Keyframe]]:
    """Sort keyframes into parts that share landmarks or a step; each part, and the parts, in order of time.

    Parts that share none can't be adjusted together: nothing would hold one's place and scale to the other's.
    """
    steps = _known_steps(world, keyframes)
    parts: list[tuple[list[int], set[int]]] = []
    for row, keyframe in enumerate(keyframes):
        seen = set(keyframe.ids[world.landmarks.rows(keyframe.ids) >= 0].tolist())
        hangs = [len(ids & seen) >= _MIN_SHARED or (row in steps and row - 1 in rows) for rows, ids in parts]
        linked, apart = (list(compress(parts, mask)) for mask in (hangs, np.logical_not(hangs)))
        members = [k for part, _ in linked for k in part]
        parts = [*apart, ([*members, row], seen.union(*(ids for _, ids in linked)))]
    return [[keyframes[row] for row in rows] for rows in sorted(sorted(rows) for rows, _ in parts)]


def _steps_within(
    steps: dict[int, PoseConstraint], keyframes: Sequence[Keyframe], part: Sequence[Keyframe]
) -> tuple[PoseConstraint, ...]:
    """Steps between keyframes of a part, by rows of the part."""
    at = {k.frame_id: row for row, k in enumerate(part)}
    row = [at.get(k.frame_id) for k in keyframes]
    ends = ((constraint, row[constraint.first], row[constraint.second]) for constraint in steps.values())
    return tuple(
        PoseConstraint(
            first, second, constraint.T_first_second, constraint.scale, _tightened(constraint.sigma)
        )
        for constraint, first, second in ends
        if first is not None and second is not None
    )


def _tightened(sigma: tuple[float, float, float]) -> tuple[float, float, float]:
    turn, way, scale = (_SHARE_OF_DRIFT * s for s in sigma)
    return turn, way, scale


def _adjust(
    world: WorldMap,
    part: list[Keyframe],
    steps: tuple[PoseConstraint, ...],
    settled: list[Keyframe],
    camera: Intrinsics,
    noise: NoiseModel,
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
    problem = assemble_problem(
        camera,
        part,
        np.stack([k.T_world_cam for k in part]),
        landmark_ids,
        world.landmarks.xyz_of(landmark_ids),
        seen.of_rows(kept, point),
        noise,
        fixed=np.arange(len(part)) == 0,
        keep_baseline=True,
        iterations=_ITERATIONS,
    )
    result = optimise(replace(problem, steps=steps))
    if not result.ok:
        logger.debug("the map of %d keyframes can't be adjusted as a whole", len(part))
        return False
    frame_ids = np.array([k.frame_id for k in (*part, *settled)], dtype=np.int64)
    T_world_cam = np.stack([*result.T_world_cam, *(k.T_world_cam for k in settled)])
    scale = np.concatenate([local_scales(result), np.ones(len(settled))])
    order = np.argsort(frame_ids)
    world.bend(frame_ids[order], T_world_cam[order], scale[order])
    world.move_landmarks(problem.landmark_ids, result.xyz)
    drop_outliers(world, result, noise)
    return True
