"""Chooses the keyframes and observations of a window: the newest ones, and older ones that hold them.

Only landmarks are points of it: tracks that are none yet help where images are clean and harm where they are
not. Two poses are fixed, for a single one and a distance hold an orbit better, but a drive worse. Twenty
keyframes correct for longer what the start of a map got wrong than ten do, and cost hardly more time: what
counts is the number of observations.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.bundle_problem import BundleProblem, assemble_problem
from semcast.server.mapping.observations import Observations, gather_observations
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.world_map import Keyframe, WorldMap

Ids = NDArray[np.int64]

#: Observations one adjustment takes at most; it has to be done before the next keyframe.
MAX_OBSERVATIONS = 4500
#: Landmarks of a window at least: with fewer, its poses are better left as tracking found them.
_MIN_LANDMARKS = 8
#: A landmark seen by this many keyframes matters to an adjustment as much as one seen by more.
_WELL_SEEN = 4
#: Share of the observations that is reserved for landmarks in the newest keyframe.
_NEWEST_SHARE = 0.4
#: Share reserved for landmarks that older keyframes outside the window saw.
_ANCHORED_SHARE = 0.3
#: Keyframes of a place seen again that hold one adjustment, at most.
_MAX_REVISITED = 3
#: Keyframes before and after each of those that hold it too: rays from one place alone would leave landmarks
#: free in depth.
_NEIGHBOURS = 1
#: Keyframes right before the window that hold it too, at most.
_MAX_BEFORE = 6
#: Keyframes before the window among which those are chosen.
_REACH_BACK = 60
#: Landmarks of the window that such a keyframe must have seen.
_MIN_SHARED = 6
#: Extent of a window, in median depths, from which on it knows its own scale.
_MIN_EXTENT = 0.2
#: Way between the keyframes that hold a window, in median depths, from which on they tell its scale. Where
#: the camera stood it is less, and as much an error of their poses: all lengths would follow that.
_LEAST_WAY = 0.01
#: The first keyframes of a submap that do not hold such a window: those of the start, or the furthest before
#: it, which were placed with the least to go by.
_NUM_UNSURE = 5


def build_problem(
    world: WorldMap,
    camera: Intrinsics,
    noise: NoiseModel,
    window_size: int,
    *,
    start: bool = False,
    iterations: int = 6,
) -> BundleProblem | None:
    """Collect the newest keyframes of the current submap and what they see.

    Older keyframes that see it too are fixed. Two of them know the scale, and then only the first of the
    newest is fixed with them; otherwise the first two are. Where all that are fixed are in one place, as
    those of a camera that stood at first, a baseline is held too.

    Args:
        world: The map.
        camera: Pinhole.
        noise: Gives each observation its sigma.
        window_size: Keyframes at most.
        start: The first adjustment of a new map: one pose and the baseline are held instead of two poses.
        iterations: Steps at most.

    Returns:
        The problem, or None when there is nothing to adjust.
    """
    submap = world.keyframes[-1].submap
    mine = world.keyframes_of(submap)
    recent = mine[-window_size:]
    if len(recent) < (2 if start else 3):
        return None
    ids = np.unique(np.concatenate([k.ids for k in recent]))
    ids = ids[world.landmarks.rows(ids) >= 0]
    anchors = _anchors(world, mine[:-window_size], recent, ids)
    views = [*anchors, *recent]
    seen = gather_observations(views, ids)
    order = _order_of_choice(ids, seen, recent[-1], len(anchors))
    used_points, kept, point = within_limit(ids, seen.point, *order, limit=MAX_OBSERVATIONS)
    if len(used_points) < _MIN_LANDMARKS:
        return None
    held = np.bincount(seen.view[kept], minlength=len(views))[: len(anchors)] >= _MIN_SHARED
    num_new = 1 if start or held.sum() >= 2 else 2
    holding = [*(k for k, holds in zip(anchors, held, strict=True) if holds), *recent[:num_new]]
    keep_baseline = start or not _tell_scale(world, holding)
    fixed = np.zeros(len(views), bool)
    fixed[: len(anchors) + (1 if keep_baseline else num_new)] = True
    landmark_ids = ids[used_points]
    problem = assemble_problem(
        camera,
        views,
        np.stack([k.T_world_cam for k in views]),
        landmark_ids,
        world.landmarks.xyz_of(landmark_ids),
        seen.of_rows(kept, point),
        noise,
        fixed=fixed,
        keep_baseline=keep_baseline,
        iterations=iterations,
    )
    # Of a map that was thinned out, the newest keyframes may be all that is left.
    is_whole = len(recent) == len(mine) == sum(part == submap for part in world.submap_of.values())
    return replace(problem, num_anchors=len(anchors), with_covariance=True, sets_unit=is_whole)


def _tell_scale(world: WorldMap, holding: list[Keyframe]) -> bool:
    """Whether keyframes that hold a window are so far apart that they tell its scale.

    The depth is that of the newest of them that sees landmarks.
    """
    places = np.stack([k.T_world_cam[:3, 3] for k in holding])
    extent = float(np.linalg.norm(places - places[0], axis=1).max())
    depths = (median_depth(world, k) for k in reversed(holding))
    return extent >= _LEAST_WAY * next((d for d in depths if np.isfinite(d)), 0.0)


def _order_of_choice(
    ids: Ids, seen: Observations, newest: Keyframe, num_anchors: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Keys ``(P,)`` by which landmarks are chosen, see ``within_limit``.

    What ties the window to older keyframes and what the newest one sees are sure of a part of the room: the
    longest tracks of a scene that stays in view would take all of it. Then what several keyframes see.
    """
    count = np.bincount(seen.point, minlength=len(ids))
    is_anchored = np.isin(np.arange(len(ids)), seen.point[seen.view < num_anchors])
    is_newest = np.isin(ids, newest.ids, assume_unique=True)
    turn = _turns(ids, count, (is_newest, _NEWEST_SHARE), (is_anchored, _ANCHORED_SHARE))
    return -np.minimum(count, _WELL_SEEN), turn


def within_limit(
    ids: Ids, point: NDArray[np.intp], *priority: NDArray[Any], limit: int = MAX_OBSERVATIONS
) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.intp]]:
    """Choose landmarks for an adjustment: seen at least twice, of no more observations than it has time for.

    Args:
        ids: ``(P,)`` landmarks.
        point: ``(M,)`` row into ``ids`` of each observation.
        priority: ``(P,)`` each, as ``np.lexsort`` takes keys: the last one counts first, and lower values go
            before higher ones. What is alike is chosen as good as at random.
        limit: Observations at most.

    Returns:
        Rows of the landmarks that are taken, which observations are (``(M,)`` bool), and the row of each of
        those into the former.
    """
    count = np.bincount(point, minlength=len(ids))
    order = np.lexsort((_scattered(ids), *priority))
    chosen = np.zeros(len(ids), bool)
    chosen[order[np.cumsum(count[order]) <= limit]] = True
    taken = np.flatnonzero(chosen & (count >= 2))
    row = np.full(len(ids), -1, np.intp)
    row[taken] = np.arange(len(taken))
    kept = row[point] >= 0
    return taken, kept, row[point[kept]]


def _turns(ids: Ids, count: NDArray[np.intp], *parts: tuple[NDArray[np.bool_], float]) -> NDArray[np.intp]:
    """When each landmark is chosen, ``(P,)``: with the first part that has room for it, else after all parts.

    Args:
        ids: ``(P,)`` landmarks.
        count: ``(P,)`` observations of each.
        parts: Which landmarks a part may choose from, and its share of an adjustment's observations.
    """
    turn = np.full(len(ids), len(parts), np.intp)
    order = np.argsort(_scattered(ids))
    for k, (wanted, share) in enumerate(parts):
        mine = order[wanted[order] & (turn[order] == len(parts))]
        turn[mine[np.cumsum(count[mine]) <= share * MAX_OBSERVATIONS]] = k
    return turn


def _scattered(ids: Ids) -> Ids:
    """Return keys that order ids as good as at random, the same every time (multiplicative hashing)."""
    return np.asarray((ids * 2_654_435_761) % 4_294_967_296)


def _anchors(world: WorldMap, older: list[Keyframe], recent: list[Keyframe], ids: Ids) -> list[Keyframe]:
    """Older keyframes that hold the window where it was, and in its scale.

    Those whose landmarks the recent ones saw again after long, and those before the window that saw some of
    the window's landmarks: where a turn makes keyframes dense, the window alone hardly has an extent to know
    its scale by. Where it has, the first of a submap would only hold the errors of its start.
    """
    again = {world.revisits[k.frame_id] for k in recent if k.frame_id in world.revisits}
    rows = [row for row, k in enumerate(older) if k.frame_id in again][-_MAX_REVISITED:]
    near = {r for row in rows for r in range(row - _NEIGHBOURS, row + _NEIGHBOURS + 1)}
    places = np.stack([k.T_world_cam[:3, 3] for k in recent])
    extent = float(np.linalg.norm(places - places[0], axis=1).max())
    first = 0 if extent < _MIN_EXTENT * median_depth(world, recent[-1]) else _NUM_UNSURE
    shared = [
        row
        for row in range(max(first, len(older) - _REACH_BACK), len(older))
        if np.isin(older[row].ids, ids, assume_unique=True).sum() >= _MIN_SHARED
    ]
    spread = np.linspace(0, len(shared) - 1, min(_MAX_BEFORE, len(shared)))
    near |= {shared[k] for k in spread.astype(int).tolist()}
    return [older[r] for r in sorted(near) if 0 <= r < len(older)]
