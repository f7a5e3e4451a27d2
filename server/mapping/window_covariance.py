"""How well the keyframes of an adjusted window are known against those that hold it, scale included.

The inverse of the information (the paper's Proposition 1) takes the errors of observations as independent of
each other. They are not: a highlight or an outline slides over a surface and takes all that is followed there
along, from view to view. Independent errors average out over thousands of observations, such ones do not, and
poses were off by several times what was stated. So the landmarks are split by place into groups, and the
window is solved again, to first order, without each: how far that moves the poses tells what errors that
neighbours share are worth (delete-a-group jackknife, after Tukey).
"""

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.dense_bundle import (
    Seen,
    Slopes,
    State,
    Window,
    linearise,
    see,
    slopes_at,
    summed,
)

Array = NDArray[np.float64]

#: Groups of landmarks at most: fewer are too few to tell a variance by, of more neighbours share errors.
_MAX_GROUPS = 16
#: With fewer than so many groups the information alone tells,
_MIN_GROUPS = 4
#: and no group has fewer landmarks.
_LEAST_IN_GROUP = 4
#: How much of a group is left out, so that what only it fixes stays fixed: at least a tenth of all there was
#: to know is left of any pose.
_LEFT_OUT = 0.9
#: Share of the information's word in the variance; the groups have no word on what none of them moves.
_SHARE_OF_INFORMATION = 0.2


def window_covariance(window: Window, state: State, *, sets_unit: bool = False) -> Array | None:
    """How well each view is known against those that are not adjusted.

    Args:
        window: What was adjusted.
        state: Where that ended.
        sets_unit: The unit of length is what the views see alike, not what those that are held say: these are
            the first of a map, and close together.

    Returns:
        ``(K, 7, 7)`` covariances of a similarity in each camera's frame: turn in radians, place in map units,
        logarithm of the scale of what it sees, against what those that are held see; zero for these. None
        where the last view is held, or nothing fixes the window.
    """
    if not window.free[-1]:
        return None
    seen = see(window, state)
    slopes = slopes_at(window, seen)
    normal = linearise(window, state, slopes)
    try:
        system, factor, scaled = normal.reduced(0.0)
        np.linalg.cholesky(system)
        inverse = np.linalg.inv(system)
        scaled_right = np.einsum("pij,pj->pi", factor, normal.right_points)
        moves = _moves_without_each(window, state, slopes, system, scaled, scaled_right)
    except np.linalg.LinAlgError:
        return None
    ends, own_variance = _ends(window, seen, factor, scaled, sets_unit=sets_unit)
    spread = inverse
    if len(moves) >= _MIN_GROUPS:
        spread = (1.0 - 1.0 / len(moves)) * moves.T @ moves
        spread = _SHARE_OF_INFORMATION * inverse + (1.0 - _SHARE_OF_INFORMATION) * spread
    if sets_unit:
        ends = _in_own_unit(ends, state.T_world_cam[window.free], state.T_world_cam[~window.free][0])
    found = ends @ spread @ ends.transpose(0, 2, 1)
    found[:, 6, 6] += own_variance
    covariances = np.zeros((len(window.free), 7, 7))
    covariances[window.free] = found
    return covariances if np.isfinite(covariances).all() else None


def _in_own_unit(ends: Array, T_world_cam: Array, T_world_first: Array) -> Array:
    """What is asked of views ``(V, 7, C)``, in the unit that is what they see alike in the mean.

    Lengths from the first camera on change with the unit, turns do not.
    """
    unit = ends[:, 6].mean(axis=0)
    way = np.einsum("vji,vj->vi", T_world_cam[:, :3, :3], T_world_cam[:, :3, 3] - T_world_first[:3, 3])
    by_unit = np.zeros((len(ends), 7))
    by_unit[:, 3:6], by_unit[:, 6] = way, 1.0
    return np.asarray(ends - by_unit[:, :, None] * unit)


def groups_by_place(xyz: Array) -> list[NDArray[np.intp]]:
    """Rows of points ``(P, 3)`` in groups of neighbours, alike in number: halved along the longest side."""
    groups = [np.arange(len(xyz))]
    while len(groups) < _MAX_GROUPS and len(groups[0]) >= 2 * _LEAST_IN_GROUP:
        halves = []
        for rows in groups:
            axis = int(np.ptp(xyz[rows], axis=0).argmax())
            order = rows[np.argsort(xyz[rows, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        groups = halves
    return groups


def _moves_without_each(
    window: Window, state: State, slopes: Slopes, system: Array, scaled: Array, scaled_right: Array
) -> Array:
    """Twists of all poses ``(G, C)`` when a group of landmarks is left out, one group in each row.

    It is a step of Gauss and Newton, negated, and for a whole group even where only a part of it is left out.
    What the window's own end is short of the minimum by is not in it.

    Args:
        window: What was adjusted.
        state: Where that ended.
        slopes: There.
        system: ``(C, C)``, see ``Normal.reduced``.
        scaled: ``(3 P, C)``, see there.
        scaled_right: ``(P, 3)``, right sides of the points, multiplied by the same factors.

    Raises:
        LinAlgError: The window is all but free, so that rounding leaves a system singular.
    """
    groups, count = groups_by_place(state.xyz), len(system)
    group_of = np.zeros(window.num_points, np.intp)
    for row, points in enumerate(groups):
        group_of[points] = row
    rows = window.of_free
    group, unknown = group_of[window.point[rows]], window.first_unknown[window.view[rows]]
    pull = np.einsum("aim,am->im", slopes.by_pose, slopes.residual.take(rows, axis=-1))
    at = group * count + unknown + np.arange(6)[:, None]
    pulls = summed(at.ravel(), pull.ravel(), len(groups) * count).reshape(len(groups), count)
    products = np.einsum("aim,ajm->ijm", slopes.by_pose, slopes.by_pose)
    at = (group * count + unknown + np.arange(6)[:, None]) * count
    at = at[:, None] + unknown + np.arange(6)[:, None]
    parts = summed(at.ravel(), products.ravel(), len(groups) * count * count)
    parts = parts.reshape(len(groups), count, count)
    by_point = scaled.reshape(-1, 3, count)
    for row, points in enumerate(groups):
        mine = by_point[points].reshape(-1, count)
        parts[row] -= mine.T @ mine
        pulls[row] -= scaled_right[points].ravel() @ mine
    return np.asarray(np.linalg.solve(system - _LEFT_OUT * parts, pulls[..., None])[..., 0])


def _ends(
    window: Window, seen: Seen, factor: Array, scaled: Array, *, sets_unit: bool
) -> tuple[Array, Array]:
    """What is asked of each free view: its twist, and the scale of what it sees.

    That is the mean of the logarithms of depths, those that are known best counting most, less that of what
    the held views see: a turn or a step of the camera changes it, and so do the landmarks, with the poses and
    by their own errors. What both see cancels: a view that sees what the one before saw has its scale, and a
    scale drifts only as fast as other landmarks take their place.

    Args:
        window: What was adjusted.
        seen: As seen there.
        factor: ``(P, 3, 3)``, see ``Normal.reduced``.
        scaled: ``(3 P, C)``, see there.
        sets_unit: See ``window_covariance``; the slopes are those of the whole mean then.

    Returns:
        Slopes ``(V, 7, C)`` by the poses' twists; and the variance ``(V,)`` that the landmarks' own errors
        add to the scale's.
    """
    num_views, free = len(window.free), window.free
    num_free = int(free.sum())
    rows = np.flatnonzero(seen.points_cam[2] > 0.0)
    view, point = window.view[rows], window.point[rows]
    x, y, z = seen.points_cam.take(rows, axis=1)
    by_point = np.einsum("mij,jm->mi", factor[point], seen.R_cam_world[2].take(rows, axis=1) / z)
    information = 1.0 / np.square(by_point).sum(axis=1)
    known = summed(view, information, num_views)
    share = information / np.maximum(known, 1e-300)[view]
    by_landmarks = np.zeros((num_views, window.num_points, 3))
    by_landmarks[view, point] = share[:, None] * by_point
    landmarks = by_landmarks.reshape(num_views, -1)
    others = np.where(free, 1.0, 0.0) if sets_unit else np.where(free, 0.0, known)
    relative = landmarks[free] - others / max(float(others.sum()), 1e-300) @ landmarks
    ends = np.zeros((num_free, 7, window.num_unknowns))
    ends[:, 6] = -(landmarks[free] if sets_unit else relative) @ scaled
    for k in range(num_free):
        ends[k, :6, 6 * k : 6 * k + 6] = np.eye(6)
    of_free = free[view]
    row = window.first_unknown[view[of_free]] // 6
    for axis, slope in ((0, -y / z), (1, x / z), (5, -1.0 / z)):
        ends[np.arange(num_free), 6, 6 * np.arange(num_free) + axis] += summed(
            row, (share * slope)[of_free], num_free
        )
    return ends, np.square(relative).sum(axis=1)
