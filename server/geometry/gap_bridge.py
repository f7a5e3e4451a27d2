"""How a camera got across a gap: its motion changes evenly from what it was before to what it is after.

How far off that is, the camera's own past tells. Gaps as long as the one that is bridged are cut out of it
and bridged in the same way, and it is known where the camera really got to: a hindcast. A hand that sways
gets other figures than a car, and nobody has to say which of them it is.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_so3, invert_transform, logs_so3
from semcast.server.geometry.whereabouts import SAME_S, Step, last_by, path_of

Array = NDArray[np.float64]

#: Parts of a gap in which the motion is taken to be steady.
_NUM_PARTS = 10
#: A span is tried on a past that holds it so many times: its gaps would overlap too much to tell anything.
_TIMES_HELD = 2.0
#: Where the past does not hold the whole span, it may hold one of these shares of it.
_SHARES = (1.0, 0.5, 0.25)
#: How far off a bridge is grows by this power of its length, as where speeds that are random walks lead.
_GROWTH = 1.5
#: Gaps that are cut out of the past, at most.
_MAX_TRIED = 24


def even_turns(gap_s: Array, rate_before: Array, rate_later: Array) -> tuple[Array, Array]:
    """Turn evenly from one rate to another.

    Args:
        gap_s: ``(...)`` seconds.
        rate_before: ``(..., 3)`` rotation in radians per second before the gap.
        rate_later: ``(..., 3)`` the same after it.

    Returns:
        ``(M + 1,)`` where parts of the gap begin and end as shares of it, and turns ``(M, ..., 3)`` in them.
    """
    ends = np.linspace(0.0, 1.0, _NUM_PARTS + 1)
    rates = [(1.0 - at) * rate_before + at * rate_later for at in 0.5 * (ends[1:] + ends[:-1])]
    return ends, np.stack([gap_s[..., None] / _NUM_PARTS * rate for rate in rates])


def cross_gap(
    T_world_before: Array, gap_s: Array, ways_per_s: tuple[Array, Array], ends: Array, turns: Array
) -> Array:
    """Go on from poses while turning as told and while the way changes evenly, in the camera's own frame.

    Args:
        T_world_before: ``(..., 4, 4)``.
        gap_s: ``(...)`` seconds.
        ways_per_s: ``(..., 3)`` each, before the gap and after it.
        ends: ``(M + 1,)`` as of ``even_turns``.
        turns: ``(M, ..., 3)`` the same.

    Returns:
        ``T_world_after (..., 4, 4)``.
    """
    T_world_cam = T_world_before.copy()
    for begin, end, turn in zip(ends[:-1], ends[1:], turns, strict=True):
        share = 0.5 * (begin + end)
        way = (end - begin) * gap_s[..., None] * ((1.0 - share) * ways_per_s[0] + share * ways_per_s[1])
        R_world_half = T_world_cam[..., :3, :3] @ exp_so3(0.5 * turn)
        T_world_cam[..., :3, 3] += (R_world_half @ way[..., None])[..., 0]
        T_world_cam[..., :3, :3] = R_world_half @ exp_so3(0.5 * turn)
    return T_world_cam


def hindcast(
    steps: Sequence[Step], gap_s: float, later_s: float, speed_s: float
) -> tuple[float, float] | None:
    """How far off ``cross_gap`` is, as it would have been on gaps in a camera's past.

    Args:
        steps: The past, oldest first.
        gap_s: Length of the gap in seconds.
        later_s: Time after it from which the motion after it is known.
        speed_s: Time before it by which the way before it is told; the turn is that of the last step.

    Returns:
        Variances per axis of the turn (square radians) and of the place (square map units) after the gap;
        None where the past is too short to tell.
    """
    if not steps:
        return None
    t_s, T_first_cam, gone = path_of(steps)
    for share in _SHARES:
        now, after, later = _gaps_in(t_s, share * gap_s, later_s)
        if t_s[-1] >= _TIMES_HELD * share * gap_s and len(now):
            break
    else:
        return None
    gaps_s, known_s = t_s[after] - t_s[now], t_s[later] - t_s[after]
    since = np.maximum(last_by(t_s, t_s[now] - speed_s), 0)
    before = (gone[now] - gone[since]) / (t_s[now] - t_s[since])[:, None]
    rate_before = logs_so3(_motion(T_first_cam, now - 1, now)[:, :3, :3]) / (t_s[now] - t_s[now - 1])[:, None]
    T_after_later = _motion(T_first_cam, after, later)
    turn_later = logs_so3(T_after_later[:, :3, :3])
    way_later = way_of(T_after_later, turn_later)
    ends, turns = even_turns(gaps_s, rate_before, turn_later / known_s[:, None])
    T_first_guess = cross_gap(T_first_cam[now], gaps_s, (before, way_later / known_s[:, None]), ends, turns)
    T_after_guess = invert_transform(T_first_cam[after]) @ T_first_guess
    grown = (gap_s / gaps_s) ** (2.0 * _GROWTH)
    errors = logs_so3(T_after_guess[:, :3, :3]), T_after_guess[:, :3, 3]
    turn, place = (float(np.mean(grown[:, None] * error**2)) for error in errors)
    return turn, place


def way_of(T_before_after: Array, turn: Array) -> Array:
    """Way ``(..., 3)`` of motions ``(..., 4, 4)`` in the frame of a camera that has turned by half of it."""
    return np.asarray((exp_so3(-0.5 * turn) @ T_before_after[..., :3, 3:])[..., 0])


def _motion(T_first_cam: Array, begin: NDArray[np.int64], end: NDArray[np.int64]) -> Array:
    return np.asarray(invert_transform(T_first_cam[begin]) @ T_first_cam[end])


def _gaps_in(t_s: Array, span_s: float, later_s: float) -> tuple[NDArray[np.int64], ...]:
    """Rows of times ``(N,)`` at which gaps begin and end, and up to which is known what came after."""
    now = np.arange(1, len(t_s))
    # One step at least: two images may have as good as one time.
    after = np.maximum(np.searchsorted(t_s, t_s[now] + span_s - SAME_S), now + 1)
    now, after = now[after + 1 < len(t_s)], after[after + 1 < len(t_s)]
    later = np.maximum(last_by(t_s, t_s[after] + later_s), after + 1)
    taken = slice(None, None, max(1, -(-len(now) // _MAX_TRIED)))
    return now[taken], after[taken], later[taken]
