import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, invert_transform, log_so3, rotation_angle_deg, transform_points
from semcast.server.geometry.pnp import refine_pose, search_pose
from semcast.server.geometry.projection import project_with_jacobian

CAMERA = Intrinsics(fx=500, fy=480, cx=320, cy=240, width=640, height=480)


def make_view(seed, num=150, sigma=0.0):
    rng = np.random.default_rng(seed)
    T_cam_world = exp_se3(rng.normal(0, 0.3, 6))
    points_cam = rng.uniform((-3, -2, 4), (3, 2, 12), (num, 3))
    points = transform_points(invert_transform(T_cam_world), points_cam)
    return T_cam_world, points, CAMERA.project(points_cam) + rng.normal(0, 1, (num, 2)) * sigma


def refine(T, points, xy, sigma=1.0, **options):
    sigma = np.full(len(points), float(sigma)) if np.ndim(sigma) == 0 else sigma
    return refine_pose(CAMERA, T, points, xy, sigma, 3.0 * sigma, **options)


def derivatives(points_cam, whitener):
    """Whitened pixels ``(N, 2)`` and their derivatives ``(N, 2, 6)``."""
    axes = (whitener @ np.diag([CAMERA.fx, CAMERA.fy])).T[:, :, None]
    projected, J = project_with_jacobian(points_cam.T, axes)
    return projected.T + whitener @ [CAMERA.cx, CAMERA.cy], J.transpose(2, 1, 0)


@pytest.mark.parametrize("whitener", [np.eye(2), np.array([[1.2, 0.5], [-0.3, 0.8]])])
def test_projection_jacobian_is_the_numeric_one(whitener):
    points = np.random.default_rng(0).uniform((-2, -2, 3), (2, 2, 8), (5, 3))
    projected, J = derivatives(points, whitener)
    assert np.allclose(projected, CAMERA.project(points) @ whitener.T)
    for k in range(6):
        xi = np.eye(6)[k] * 1e-6
        moved = CAMERA.project(transform_points(exp_se3(xi), points)) @ whitener.T
        assert np.allclose((moved - projected) / 1e-6, J[:, :, k], atol=1e-2)


@pytest.mark.parametrize("seed", range(6))
def test_exact_observations_give_the_exact_pose(seed):
    T, points, xy = make_view(seed)
    start = exp_se3(np.random.default_rng(seed).normal(0, 0.03, 6)) @ T
    found = refine(start, points, xy)
    assert np.abs(found.T_cam_world - T).max() < 1e-6
    assert found.inliers.all()


def test_outliers_do_not_move_the_pose():
    T, points, xy = make_view(1, sigma=0.3)
    xy[:45] += np.random.default_rng(1).uniform(15, 60, (45, 2))
    found = refine(exp_se3(np.full(6, 0.01)) @ T, points, xy, 0.3)
    assert rotation_angle_deg(found.T_cam_world[:3, :3] @ T[:3, :3].T) < 0.05
    assert found.inliers[45:].mean() > 0.95
    assert not found.inliers[:45].any()


@pytest.mark.parametrize("sigma", [0.3, 4.0])
def test_the_pose_is_where_hubers_loss_is_least(sigma):
    T, points, xy = make_view(3, sigma=sigma)
    xy[::5] += 2.5 * sigma  # all to one side, and near enough to count
    found = refine(T, points, xy, sigma, iterations=40).T_cam_world

    def loss(twist):
        size = np.linalg.norm(CAMERA.project(transform_points(exp_se3(twist) @ found, points)) - xy, axis=1)
        a = size / sigma
        return np.where(a < 1.345, 0.5 * a * a, 1.345 * (a - 0.5 * 1.345)).sum()

    for step in 1e-4 * np.eye(6):
        slope = (loss(step) - loss(-step)) / 2e-4
        bend = (loss(step) - 2.0 * loss(np.zeros(6)) + loss(-step)) / 1e-8
        assert abs(slope) < 1e-6 * bend, "a step would be shorter than a millionth"


def test_covariance_of_proposition_1_is_the_inverse_of_the_information():
    T, points, exact = make_view(2, num=20)
    sigma = np.linspace(0.2, 1.5, 20)
    _, J = derivatives(transform_points(T, points), np.eye(2))
    information = sum(j.T @ j / s**2 for j, s in zip(J, sigma, strict=True))
    assert np.allclose(refine(T, points, exact, sigma).covariance @ information, np.eye(6), atol=1e-4)


def test_covariance_of_proposition_1_by_monte_carlo():
    T, points, exact = make_view(2, num=60)
    rng = np.random.default_rng(2)
    sigma = rng.uniform(0.2, 1.5, 60)
    predicted = refine(T, points, exact, sigma).covariance
    assert predicted is not None
    deviations = []
    for _ in range(400):
        noisy = exact + rng.normal(0, 1, exact.shape) * sigma[:, None]
        # Wide limits: the proposition is about least squares, not about the robust loss.
        found = refine_pose(CAMERA, T, points, noisy, sigma, 100 * sigma, iterations=6)
        D = found.T_cam_world @ invert_transform(T)
        deviations.append(np.concatenate([log_so3(D[:3, :3]), D[:3, 3]]))
    measured = np.cov(np.array(deviations).T)
    scale = np.sqrt(np.diag(predicted))
    # 400 samples: 3.5 % standard error of a standard deviation; Huber costs up to 5 % of efficiency.
    assert np.allclose(np.sqrt(np.diag(measured)) / scale, 1.0, atol=0.16)
    correlation = (measured - predicted) / np.outer(scale, scale)
    assert np.abs(correlation).max() < 0.35


def test_weights_make_the_estimate_better_than_equal_ones():
    errors = np.zeros((40, 2))
    for seed in range(40):
        T, points, exact = make_view(seed, num=50)
        rng = np.random.default_rng(seed)
        sigma = np.where(np.arange(50) % 2, 0.2, 2.0)
        noisy = exact + rng.normal(0, 1, exact.shape) * sigma[:, None]
        for k, s in enumerate((sigma, np.full(50, 1.0))):
            found = refine_pose(CAMERA, T, points, noisy, s, np.full(50, 50.0))
            errors[seed, k] = np.linalg.norm(found.T_cam_world[:3, 3] - T[:3, 3])
    assert errors[:, 0].mean() < 0.75 * errors[:, 1].mean()


def test_points_behind_the_camera_are_no_inliers():
    T, points, xy = make_view(4, num=40)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    found = refine(flip @ T, points, xy)
    assert found.num_inliers == 0
    assert np.isfinite(found.T_cam_world).all()
    assert found.covariance is None


def test_one_point_repeated_gives_no_covariance():
    found = refine(np.eye(4), np.tile([[0.0, 0, 5]], (20, 1)), np.tile([[320.0, 240]], (20, 1)))
    assert found.covariance is None
    assert np.isfinite(found.T_cam_world).all()


def test_search_needs_no_start():
    T, points, xy = make_view(5, sigma=0.3)
    xy[:60] = np.random.default_rng(5).uniform(0, 480, (60, 2))
    sigma = np.full(len(points), 0.5)
    found = search_pose(CAMERA, points, xy, sigma, 4 * sigma, seed=0)
    assert found is not None
    assert rotation_angle_deg(found.T_cam_world[:3, :3] @ T[:3, :3].T) < 0.2
    assert found.inliers[60:].mean() > 0.9


def test_a_pose_that_was_found_is_not_lost_to_wrong_points_next_to_the_camera():
    # Points next to the camera move most with it: refined by all points, the pose went off with them.
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T, _, _ = make_view(seed)
        points_cam = np.vstack([rng.uniform((-1, -1, 2), (1, 1, 4), (30, 3)), np.zeros((40, 3))])
        points_cam[30:] = rng.uniform((-1, -1, 0.02), (1, 1, 0.3), (40, 3))
        xy = CAMERA.project(points_cam) + rng.normal(0, 2, (70, 2))
        xy[30:] = rng.uniform(0, (200, 150), (40, 2))
        sigma, points = np.full(70, 2.5), transform_points(invert_transform(T), points_cam)
        found = search_pose(CAMERA, points, xy, sigma, 3 * sigma, seed=0, min_inliers=8, max_iterations=400)
        assert found is not None
        assert rotation_angle_deg(found.T_cam_world[:3, :3] @ T[:3, :3].T) < 2.0


def test_search_among_nonsense_finds_nothing():
    rng = np.random.default_rng(6)
    sigma = np.full(40, 0.5)
    points, xy = rng.normal(0, 1, (40, 3)), rng.uniform(0, 480, (40, 2))
    assert search_pose(CAMERA, points, xy, sigma, 3 * sigma, seed=0, min_inliers=15) is None
    assert search_pose(CAMERA, points[:3], xy[:3], sigma[:3], sigma[:3], seed=0) is None


def test_points_that_slid_along_edges_hold_the_camera_across_them():
    errors = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T, points, exact = make_view(seed, num=60)
        angle = rng.uniform(0, np.pi, 60)
        along = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        xy = exact + along * rng.normal(0, 2.0, (60, 1)) + across * rng.normal(0, 0.1, (60, 1))
        edge = 0.5 * np.log(20.0) * along
        start = exp_se3(rng.normal(0, 0.02, 6)) @ T
        sigma = np.sqrt(0.2)
        found = [refine(start, points, xy, sigma, edge=e) for e in (edge, None)]
        errors.append([np.linalg.norm((f.T_cam_world @ invert_transform(T))[:3, 3]) for f in found])
        assert found[0].inliers.mean() > 0.95
    shaped, alike = np.mean(errors, axis=0)
    assert shaped < 0.3 * alike
