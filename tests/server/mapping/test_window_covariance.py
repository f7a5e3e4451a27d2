from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, exp_so3, invert_transform, make_transform, transform_points
from semcast.server.mapping import window_covariance as covariance_of_window
from semcast.server.mapping.dense_bundle import State, Window, linearise, minimise, see, slopes_at
from semcast.server.mapping.window_covariance import groups_by_place, window_covariance

CAMERA = Intrinsics(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480)
NUM_VIEWS, NUM_POINTS = 6, 160
#: All see the first half of the landmarks; of the others, early views see some and late ones the rest.
SEES = np.where(np.arange(NUM_VIEWS)[:, None] < 3, np.arange(NUM_POINTS) < 120, np.arange(NUM_POINTS) >= 120)
SEES[:, :80] = True
VIEW, POINT = np.nonzero(SEES)


def scene():
    """Poses and points that are the truth in all tests."""
    rng = np.random.default_rng(5)
    T_world_cam = np.stack(
        [
            make_transform(exp_so3(rng.normal(0, 0.05, 3)), (0.4 * k, 0.1 * rng.normal(), 0.1 * k))
            for k in range(NUM_VIEWS)
        ]
    )
    return T_world_cam, rng.uniform((-2, -1.5, 5), (4, 1.5, 12), (NUM_POINTS, 3))


def solved_window(noise_px, sigma_px, points=None, *, sets_unit=False):
    """A window seen with noise ``(M, 2)`` and solved from the truth: with its covariances, and the truth."""
    T_world_cam, xyz = scene()
    cam = np.stack([transform_points(invert_transform(T), xyz) for T in T_world_cam])[VIEW, POINT]
    kept = np.ones(len(VIEW), bool) if points is None else points > POINT
    window = Window(
        camera=CAMERA,
        free=np.arange(NUM_VIEWS) >= 2,
        num_points=int(POINT[kept].max()) + 1,
        view=VIEW[kept],
        point=POINT[kept],
        xy=(CAMERA.project(cam) + noise_px)[kept],
        whitener=np.repeat(np.eye(2)[:, :, None] / sigma_px, int(kept.sum()), axis=2),
        limit=np.full(int(kept.sum()), 1e3),
        baseline=None,
    )
    state = minimise(window, State(T_world_cam, xyz[: window.num_points]), 10)
    covariances = window_covariance(window, state, sets_unit=sets_unit)
    return window, state, covariances, (T_world_cam, xyz[: window.num_points])


def depths_of(T_world_cam, xyz):
    """``(K, P)``."""
    return np.stack([transform_points(invert_transform(T), xyz)[:, 2] for T in T_world_cam])


def by_landmarks(window, state):
    """How logarithms of depths depend on landmarks ``(K, P, 3)``, and how well each is known ``(K, P)``."""
    factor = linearise(window, state, slopes_at(window, see(window, state))).reduced(0.0)[1]
    z_axis = state.T_world_cam[:, None, :3, 2] / depths_of(state.T_world_cam, state.xyz)[..., None]
    by_point = np.einsum("pij,kpj->kpi", factor, z_axis)
    return by_point, SEES / np.square(by_point).sum(axis=2)


def last_error(window, state, truth):
    """The last view's error as a similarity in its frame: twist, and what is missing to the depths.

    Less what is missing to those that the held views see.
    """
    T_cam_true = invert_transform(state.T_world_cam[-1]) @ truth[0][-1]
    turn = 0.5 * np.array([T_cam_true[2, 1] - T_cam_true[1, 2], T_cam_true[0, 2] - T_cam_true[2, 0],
                           T_cam_true[1, 0] - T_cam_true[0, 1]])  # fmt: skip
    longer = np.log(depths_of(*truth) / depths_of(*vars(state).values()))
    known = by_landmarks(window, state)[1]
    last, held = (np.average(longer[k], weights=known[k]) for k in (np.s_[-1:], np.s_[:2]))
    return np.array([*turn, *T_cam_true[:3, 3], last - held])


def in_own_unit(state, truth):
    """The state in the unit in which views see what they see as far away as it is, in the mean."""
    logs = np.log(depths_of(*truth) / depths_of(*vars(state).values()))[2:]
    unit, first = np.exp(np.average(logs, weights=SEES[2:])), truth[0][0, :3, 3]
    T_world_cam = state.T_world_cam.copy()
    T_world_cam[:, :3, 3] = first + unit * (T_world_cam[:, :3, 3] - first)
    return State(T_world_cam, first + unit * (state.xyz - first))


def true_over_stated(draw_noise, sigma_px, num=50, *, sets_unit=False):
    """Root mean squares of the last view's errors over what was stated, ``(7,)``."""
    errors, variances = [], []
    for seed in range(num):
        noise = draw_noise(np.random.default_rng(seed))
        window, state, covariances, truth = solved_window(noise, sigma_px, sets_unit=sets_unit)
        state = in_own_unit(state, truth) if sets_unit else state
        errors.append(last_error(window, state, truth))
        variances.append(np.diag(covariances[-1]))
    return np.sqrt(np.square(errors).mean(axis=0) / np.mean(variances, axis=0))


def test_errors_that_are_independent_are_as_large_as_stated():
    ratio = true_over_stated(lambda rng: rng.normal(0, 0.5, (len(VIEW), 2)), 0.5)
    np.testing.assert_allclose(ratio, 1.0, atol=0.35)


def test_a_window_that_sets_the_unit_is_off_by_what_is_left_in_that_unit():
    draw_noise = lambda rng: rng.normal(0, 0.5, (len(VIEW), 2))  # noqa: E731
    np.testing.assert_allclose(true_over_stated(draw_noise, 0.5, sets_unit=True)[:6], 1.0, atol=0.35)
    noise = draw_noise(np.random.default_rng(0))
    held, own = (solved_window(noise, 0.5, sets_unit=sets_unit)[2][-1] for sets_unit in (False, True))
    np.testing.assert_allclose(own[:3, :3], held[:3, :3], rtol=1e-9, err_msg="turns have no unit")
    assert own[6, 6] < 0.3 * held[6, 6]


def shared_by_neighbours(rng):
    """What is followed on one part of a surface slides along with it, from view to view."""
    groups = groups_by_place(scene()[1])
    group_of = np.zeros(NUM_POINTS, int)
    for row, points in enumerate(groups):
        group_of[points] = row
    slid = np.cumsum(rng.normal(0, 0.4, (NUM_VIEWS, len(groups), 2)), axis=0)
    return slid[VIEW, group_of[POINT]] + rng.normal(0, 0.1, (len(VIEW), 2))


def test_errors_that_neighbours_share_are_as_large_as_stated(monkeypatch):
    ratio = true_over_stated(shared_by_neighbours, 0.7)
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)
    monkeypatch.setattr(covariance_of_window, "_MIN_GROUPS", 99)
    alone = true_over_stated(shared_by_neighbours, 0.7)
    assert alone[:3].max() > 1.8, "the information alone says that they average out"


def test_few_landmarks_say_what_their_information_is_worth():
    window, state, covariances, _ = solved_window(np.zeros((len(VIEW), 2)), 0.5, points=12)
    system = linearise(window, state, slopes_at(window, see(window, state))).reduced(0.0)[0]
    np.testing.assert_allclose(covariances[-1, :6, :6], np.linalg.inv(system)[-6:, -6:], rtol=1e-6)
    assert not covariances[:2].any(), "views that are held"


@pytest.mark.parametrize("sets_unit", [False, True])
def test_the_scale_is_that_of_the_depths(sets_unit):
    # By hand: views turn and step as they like, and landmarks go where that leaves them.
    window, state, _, _ = solved_window(np.zeros((len(VIEW), 2)), 0.5)
    seen = see(window, state)
    normal = linearise(window, state, slopes_at(window, seen))
    _, factor, scaled = normal.reduced(0.0)
    ends, own = covariance_of_window._ends(window, seen, factor, scaled, sets_unit=sets_unit)
    assert ends.shape == (4, 7, 24)
    twists = np.random.default_rng(2).normal(0, 1e-5, 24)
    moved = state.T_world_cam.copy()
    moved[2:] = moved[2:] @ exp_se3(twists.reshape(4, 6))
    xyz = state.xyz - np.einsum("pji,pj->pi", factor, (scaled @ twists).reshape(-1, 3))
    by_point, share = by_landmarks(window, state)
    known = share.sum(axis=1)
    longer = np.log(depths_of(moved, xyz) / depths_of(state.T_world_cam, state.xyz))
    longer = (share * longer).sum(axis=1) / known
    against = np.where(window.free, 1.0, 0.0) if sets_unit else np.where(window.free, 0.0, known)
    against /= against.sum()
    expected = longer[2:] if sets_unit else longer[2:] - against @ longer
    np.testing.assert_allclose(ends[:, 6] @ twists, expected, rtol=1e-3)
    np.testing.assert_array_equal(np.einsum("vij,j->vi", ends[:, :6], twists), twists.reshape(4, 6))
    by_landmark = (share / known[:, None])[..., None] * by_point
    others = np.einsum("k,kpi->pi", against, by_landmark)
    np.testing.assert_allclose(own, np.square(by_landmark[2:] - others).sum(axis=(1, 2)))


def test_without_a_group_poses_move_as_a_window_with_little_weight_on_it_would():
    noise = np.random.default_rng(3).normal(0, 1.0, (len(VIEW), 2))
    window, state, _, _ = solved_window(noise, 1.0)
    state = minimise(window, state, 20)
    slopes = slopes_at(window, see(window, state))
    normal = linearise(window, state, slopes)
    system, factor, scaled = normal.reduced(0.0)
    right = np.einsum("pij,pj->pi", factor, normal.right_points)
    moves = covariance_of_window._moves_without_each(window, state, slopes, system, scaled, right)
    left_out = covariance_of_window._LEFT_OUT
    for points, move in zip(groups_by_place(state.xyz), moves, strict=True):
        weight = np.where(np.isin(window.point, points), np.sqrt(1.0 - left_out), 1.0)
        lighter = replace(window, whitener=window.whitener * weight)
        twists = linearise(lighter, state, slopes_at(lighter, see(lighter, state))).step(0.0)[0]
        np.testing.assert_allclose(-left_out * move, twists, atol=1e-3 * np.abs(moves).max())


def test_a_window_that_nothing_fixes_has_no_covariance():
    window, state, _, _ = solved_window(np.zeros((len(VIEW), 2)), 0.5)
    assert window_covariance(replace(window, free=np.ones(NUM_VIEWS, bool)), state) is None
    assert window_covariance(replace(window, free=np.arange(NUM_VIEWS) < 2), state) is None, (
        "the last is held"
    )


def test_groups_are_neighbours_and_alike_in_number():
    xyz = np.random.default_rng(0).uniform(0, 1, (161, 3))
    groups = groups_by_place(xyz)
    assert len(groups) == 16
    assert sorted(np.concatenate(groups).tolist()) == list(range(161))
    assert {len(g) for g in groups} == {10, 11}
    assert max(np.ptp(xyz[g], axis=0).prod() for g in groups) < 0.15
    assert len(groups_by_place(xyz[:31])) == 4
    assert len(groups_by_place(xyz[:7])) == 1
