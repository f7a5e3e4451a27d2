from dataclasses import replace

import numpy as np
import pytest
from small_windows import CAMERA, make_problem, pose_error

from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.edges import alike, rounded
from semcast.server.geometry.projection import project_with_jacobian
from semcast.server.mapping import bundle, dense_bundle
from semcast.server.mapping.bundle import optimise, quantised_sigma, residuals_px
from semcast.server.mapping.bundle_problem import BundleProblem
from semcast.server.mapping.pose_graph import PoseConstraint


def test_an_exact_window_is_recovered():
    problem, T_world_cam, xyz = make_problem(noise_px=0.0)
    result = optimise(problem)
    assert result.ok
    assert pose_error(result, T_world_cam) < 1e-4
    assert np.abs(result.xyz - xyz).max() < 1e-3
    assert np.abs(result.residual_px).max() < 1e-2
    assert np.array_equal(result.T_world_cam[:2], problem.T_world_cam[:2])


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [0, 3, 5, 4, 2, 1]], ids=["away", "and back"])
def test_one_fixed_pose_and_the_longest_baseline_hold_the_gauge(order):
    problem, T_world_cam, xyz = make_problem(noise_px=0.0, shake=0.0)
    truth = T_world_cam[order]
    # All but the view furthest away begins a tenth too far from the first, whose pose is fixed.
    start, furthest = truth.copy(), order.index(5)
    start[:, :3, 3] += 0.1 * (truth[:, :3, 3] - truth[0, :3, 3])
    start[furthest] = truth[furthest]
    changes = {
        "T_world_cam": start,
        "xyz": xyz + 0.1 * (xyz - truth[0, :3, 3]),
        "view": np.argsort(order)[problem.view],
        "fixed": np.arange(6) < 1,
        "keep_baseline": True,
        "iterations": 30,
    }
    result = optimise(BundleProblem(**{**vars(problem), **changes}))
    assert result.ok
    assert pose_error(result, truth) < 1e-3
    free = optimise(BundleProblem(**{**vars(problem), **changes, "keep_baseline": False}))
    assert pose_error(free, truth) > 0.02, "where nothing holds it, the scale is that of most views"


@pytest.mark.parametrize("solver", ["dense", "gtsam"])
def test_a_baseline_ends_at_a_free_view_where_one_of_long_ago_is_further_away(solver):
    problem, truth, xyz = make_problem(noise_px=0.0, shake=0.0, num_views=8)
    truth[1, :3, 3] += (0.0, 9.0, 0.0)
    start = truth.copy()
    start[3:7, :3, 3] += 0.1 * (truth[3:7, :3, 3] - truth[2, :3, 3])
    seen = problem.view >= 2
    changes = {
        **{
            name: vars(problem)[name][seen]
            for name in ("view", "point", "xy", "sigma_px", "confidence", "edge")
        },
        "T_world_cam": start,
        "fixed": np.arange(8) <= 2,
        "xyz": xyz + 0.1 * (xyz - truth[2, :3, 3]),
        "keep_baseline": True,
        "iterations": 30,
        "solver": solver,
    }
    result = optimise(replace(problem, **changes))
    assert result.ok
    assert pose_error(result, truth) < 1e-3


def test_right_weights_give_smaller_errors_than_equal_ones():
    errors = []
    for seed in range(4):
        truth_sigma = lambda view, point, rng: np.where(point % 3 == 0, 0.15, 3.0)  # noqa: E731
        weighted, T_world_cam, _ = make_problem(seed, sigma_px=truth_sigma)
        equal = BundleProblem(**{**vars(weighted), "sigma_px": np.full(len(weighted.xy), 1.0)})
        errors.append([pose_error(optimise(p), T_world_cam) for p in (weighted, equal)])
    ours, theirs = np.mean(errors, axis=0)
    assert ours < 0.5 * theirs


def test_residuals_show_the_outlier():
    problem, _, _ = make_problem(noise_px=0.2)
    xy = problem.xy.copy()
    xy[7] += (40.0, 0.0)
    result = optimise(BundleProblem(**{**vars(problem), "xy": xy}))
    size = np.linalg.norm(result.residual_px, axis=1)
    assert int(np.nanargmax(size)) == 7
    assert np.median(size) < 0.6


def test_covariance_is_the_inverse_of_the_information_where_points_are_free_and_two_poses_are_not():
    sigma = float(quantised_sigma(np.ones(1))[0][8])
    problem, T_world_cam, xyz = make_problem(
        num_views=4, num_points=12, noise_px=0.0, shake=0.0, iterations=1
    )
    result = optimise(BundleProblem(**{**vars(problem), "sigma_px": np.full(len(problem.xy), sigma)}))
    # Unknowns: poses 2 and 3, each moved in its own frame, and the points.
    jacobian = np.zeros((len(problem.xy), 2, 12 + 3 * 12))
    for row, (k, p) in enumerate(zip(problem.view, problem.point, strict=True)):
        T_cam_world = invert_transform(T_world_cam[k])
        xyz_cam, axes = transform_points(T_cam_world, xyz[p][None]).T, np.diag([CAMERA.fx, CAMERA.fy])
        J = project_with_jacobian(xyz_cam, axes[:, :, None])[1].transpose(2, 1, 0)
        if k >= 2:
            jacobian[row, :, 6 * k - 12 : 6 * k - 6] = J[0]
        jacobian[row, :, 12 + 3 * p : 15 + 3 * p] = J[0][:, 3:] @ T_cam_world[:3, :3]
    rows = jacobian.reshape(-1, jacobian.shape[-1]) / sigma
    expected = np.linalg.inv(rows.T @ rows)[6:12, 6:12]
    scale = np.sqrt(np.diag(expected))
    found = result.covariances[-1, :6, :6]
    assert np.allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-3)


@pytest.mark.parametrize("solver", ["dense", "gtsam"])
def test_covariances_are_those_of_the_poses(solver):
    tight, loose = (optimise(make_problem(noise_px=s, solver=solver)[0]) for s in (0.2, 0.8))
    assert tight.covariances.shape == (6, 7, 7)
    assert not tight.covariances[:2].any(), "of those that are held"
    ratio = np.sqrt(np.diagonal(loose.covariances[2:], 0, 1, 2) / np.diagonal(tight.covariances[2:], 0, 1, 2))
    assert np.allclose(ratio, 4.0, rtol=0.1)
    assert optimise(make_problem(with_covariance=False, solver=solver)[0]).covariances is None
    start = optimise(make_problem(noise_px=0.2, solver=solver, sets_unit=True)[0])
    assert start.covariances[-1, 6, 6] < 0.7 * tight.covariances[-1, 6, 6]


def test_a_point_behind_a_camera_is_left_out():
    problem, T_world_cam, _ = make_problem(noise_px=0.1)
    xyz = problem.xyz.copy()
    xyz[0] = (0, 0, -5)
    result = optimise(BundleProblem(**{**vars(problem), "xyz": xyz}))
    assert result.ok
    assert pose_error(result, T_world_cam) < 0.05
    assert np.isnan(result.residual_px[problem.point == 0]).all()
    assert np.array_equal(result.xyz[0], xyz[0])


def test_a_point_takes_part_from_its_second_view_on():
    problem, _, xyz = make_problem(noise_px=0.0)
    kept = ~((problem.point == 0) & (problem.view > 1)) & ~((problem.point == 1) & (problem.view != 5))
    of_kept = {
        name: vars(problem)[name][kept] for name in ("view", "point", "xy", "sigma_px", "confidence", "edge")
    }
    result = optimise(BundleProblem(**{**vars(problem), **of_kept}))
    assert np.allclose(result.xyz[0], xyz[0], atol=1e-3), "seen by two"
    assert np.isfinite(result.residual_px[of_kept["point"] == 0]).all()
    assert np.array_equal(result.xyz[1], problem.xyz[1]), "seen by one, left out"
    assert np.isnan(result.residual_px[of_kept["point"] == 1]).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"fixed": np.zeros(6, bool)},
        {"xyz": np.full((60, 3), (0.0, 0.0, -4.0))},
        {"xy": np.full((360, 2), np.nan)},
        {"T_world_cam": np.stack([np.eye(4)] * 6), "xyz": np.full((60, 3), (0.0, 0.0, 5.0))},
        {"T_world_cam": np.stack([np.eye(4)] * 6), "keep_baseline": True},
        {"T_world_cam": np.stack([1.3 * np.eye(4)] * 6)},
        {"xy": np.concatenate([np.zeros((300, 2)), np.full((60, 2), np.nan)])},
        {"view": np.repeat(np.arange(6), 60) % 5},
    ],
    ids=[
        "no gauge",
        "all behind",
        "nan",
        "no parallax",
        "no baseline",
        "no rotations",
        "nothing seen last",
        "unseen pose",
    ],
)
def test_degenerate_windows_end_without_an_exception(changes):
    problem, _, _ = make_problem()
    for result in both_ways(BundleProblem(**{**vars(problem), **changes})):
        assert np.isfinite(result.xyz).all()
        assert np.isfinite(result.T_world_cam).all()
        if not result.ok:
            assert np.array_equal(result.xyz, result.problem.xyz)


def test_a_pose_that_is_not_finite_is_an_adjustment_that_failed():
    problem, _, _ = make_problem()
    T_world_cam = problem.T_world_cam.copy()
    T_world_cam[3, 0, 0] = np.nan
    result = optimise(BundleProblem(**{**vars(problem), "T_world_cam": T_world_cam}))
    assert not result.ok
    np.testing.assert_array_equal(result.T_world_cam, T_world_cam)
    np.testing.assert_array_equal(result.xyz, problem.xyz)


def both_ways(problem):
    """By dense algebra and by GTSAM, which rounds standard deviations and shapes."""
    sigmas, step = quantised_sigma(problem.sigma_px)
    problem = replace(problem, sigma_px=sigmas[step], edge=rounded(problem.edge))
    return optimise(problem), optimise(replace(problem, solver="gtsam"))


@pytest.mark.parametrize("fixed_last", [True, False], ids=["held", "unseen"])
def test_a_last_pose_that_is_held_or_unseen_has_no_covariance(fixed_last):
    problem, T_world_cam, _ = make_problem(noise_px=0.1)
    seen = np.ones(len(problem.view), bool) if fixed_last else problem.view != 5
    names = ("view", "point", "xy", "sigma_px", "confidence", "edge")
    kept = {name: vars(problem)[name][seen] for name in names}
    fixed = problem.fixed | (fixed_last & (np.arange(6) == 5))
    result = optimise(BundleProblem(**{**vars(problem), **kept, "fixed": fixed}))
    assert result.ok
    assert result.covariances is None
    np.testing.assert_allclose(result.T_world_cam[5], problem.T_world_cam[5], atol=1e-12)
    assert np.linalg.norm(result.T_world_cam[2:5, :3, 3] - T_world_cam[2:5, :3, 3], axis=1).max() < 0.05


def test_a_last_pose_that_saw_a_single_point_has_no_covariance():
    problem, _, _ = make_problem(noise_px=0.1)
    seen = (problem.view != 5) | (problem.point == 0)
    names = ("view", "point", "xy", "sigma_px", "confidence", "edge")
    kept = {name: vars(problem)[name][seen] for name in names}
    result = optimise(BundleProblem(**{**vars(problem), **kept}))
    assert result.ok
    assert result.covariances is None


@pytest.mark.parametrize(("solver", "other"), [("dense", "_by_gtsam"), ("gtsam", "_by_dense_algebra")])
def test_the_solver_is_the_one_that_is_set_and_gives_a_covariance_where_it_is_wanted(
    monkeypatch, solver, other
):
    monkeypatch.setattr(bundle, other, None)
    problem, _, _ = make_problem(solver=solver)
    assert optimise(problem).covariances is not None
    assert optimise(replace(problem, with_covariance=False)).covariances is None


def test_points_are_adjusted_where_all_poses_are_held():
    problem, _, xyz = make_problem(noise_px=0.0, shake=0.0)
    moved = BundleProblem(**{**vars(problem), "fixed": np.ones(6, bool), "xyz": xyz + 0.02})
    result = optimise(moved)
    assert result.ok
    np.testing.assert_allclose(result.xyz, xyz, atol=1e-4)


def test_sigmas_share_sixteen_models():
    sigmas, step = quantised_sigma(np.array([0.0001, 0.1, 1.0, 12.0, 500.0]))
    assert len(sigmas) == 16
    assert step.tolist()[:2] == [0, 0]
    assert step.tolist()[3:] == [15, 15]
    assert sigmas[step[2]] == pytest.approx(1.0, rel=0.2)


def step_between(T_world_cam, first, second, sigma=(0.001, 0.001, 1.0)):
    T = invert_transform(T_world_cam[first]) @ T_world_cam[second]
    return PoseConstraint(first, second, T, 1.0, sigma)


def test_a_view_that_saw_nothing_goes_where_a_step_leads():
    problem, T_world_cam, _ = make_problem()
    seen = problem.view != 4
    parts = {name: getattr(problem, name)[seen] for name in ("view", "point", "xy", "sigma_px", "confidence")}
    steps = (step_between(T_world_cam, 3, 4),)
    result = optimise(replace(problem, **parts, edge=alike(), steps=steps))
    assert result.ok
    T = invert_transform(result.T_world_cam[3]) @ result.T_world_cam[4]
    np.testing.assert_allclose(T, steps[0].T_first_second, atol=1e-4)
    assert pose_error(result, T_world_cam) < 0.05


def test_a_step_that_observations_contradict_does_little():
    problem, T_world_cam, _ = make_problem()
    alone = pose_error(optimise(problem), T_world_cam)
    astray = T_world_cam.copy()
    astray[4, 0, 3] += 1.0
    steps = (step_between(astray, 3, 4, (0.01, 0.05, 1.0)),)
    assert pose_error(optimise(replace(problem, steps=steps)), T_world_cam) < alone + 0.05


def test_residuals_by_hand():
    problem, _, _ = make_problem()
    changes = {"view": np.array([0]), "point": np.array([0]), "xy": np.array([[330.0, 235.0]])}
    one = BundleProblem(**{**vars(problem), **changes, "edge": alike()})
    residual, front = residuals_px(one, np.eye(4)[None], np.array([[0.0, 0.0, 2.0]]))
    assert residual.tolist() == [[10.0, -5.0]]
    assert front.tolist() == [True]


def test_the_weight_is_outside_of_the_loss_in_the_papers_objective_and_inside_in_our_own():
    sigmas, _ = quantised_sigma(np.ones(1))
    sigma, residual_px, limit_px = sigmas[8], 5.0, 1.0
    one = {
        "fixed": np.array([False]),
        "T_world_cam": np.eye(4)[None],
        "xyz": np.array([[0.0, 0.0, 2.0]]),
        "xy": np.array([[CAMERA.cx + residual_px, CAMERA.cy]]),
        "view": np.array([0]),
        "point": np.array([0]),
        "sigma_px": np.array([sigma]),
        "edge": alike(),
    }
    problem = BundleProblem(**{**vars(make_problem()[0]), **one})
    paper = BundleProblem(**{**vars(problem), "huber_px": limit_px})
    used = np.array([True])
    # Eq. 22: w rho(r), with rho linear beyond the limit: sigma^-2 (1 * 5 - 1 / 2).
    graph, values = bundle._build(paper, used)
    assert graph.error(values) == pytest.approx(4.5 / sigma**2)
    # Ours: rho(r / sigma), linear beyond 1.345 sigma.
    graph, values = bundle._build(problem, used)
    assert graph.error(values) == pytest.approx(1.345 * (residual_px / sigma - 1.345 / 2))
    for asked in (paper, problem):
        graph, values = bundle._build(asked, used)
        window, state, _ = bundle._window_of(asked, used)
        assert dense_bundle.see(window, state).cost == pytest.approx(graph.error(values))


def test_a_window_of_points_that_slid_along_edges():
    errors = []
    for seed in range(4):
        problem, T_world_cam, _ = make_problem(seed=seed, noise_px=0.0, sigma_px=lambda view, *_: 0.0 * view)
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0, np.pi, 60)[problem.point]
        along = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        slid = along * rng.normal(0, 1.5, (len(angle), 1)) + across * rng.normal(0, 0.1, (len(angle), 1))
        values = {**vars(problem), "xy": problem.xy + slid, "sigma_px": np.full(len(angle), np.sqrt(0.15))}
        edge = 0.5 * np.log(15.0) * along
        found = [optimise(BundleProblem(**{**values, "edge": e})) for e in (edge, alike())]
        errors.append([pose_error(result, T_world_cam) for result in found])
    shaped, round_ = np.mean(errors, axis=0)
    assert shaped < 0.6 * round_
