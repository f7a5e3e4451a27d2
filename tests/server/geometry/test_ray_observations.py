"""Points of which only the ray is known: distances, derivatives, and what they tell of a pose."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import (
    exp_se3,
    exp_so3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
    transform_points,
)
from semcast.server.geometry.pnp import refine_pose
from semcast.server.geometry.ray_observations import RayObservations

CAMERA = Intrinsics(fx=500, fy=480, cx=320, cy=240, width=640, height=480)
MIN_DEPTH = 1.0


def seen_by_two(seed, num=60, T_world_origin=None, T_cam_origin=None):
    """Points before one camera, their rays from there, and the pose of another that sees them."""
    rng = np.random.default_rng(seed)
    T_world_origin = exp_se3(rng.normal(0, 0.3, 6)) if T_world_origin is None else T_world_origin
    T_cam_origin = exp_se3(rng.normal(0, 0.1, 6)) if T_cam_origin is None else T_cam_origin
    points = rng.uniform((-3, -2, 4), (3, 2, 12), (num, 3))
    T_cam_world = T_cam_origin @ invert_transform(T_world_origin)
    return T_cam_world, on_rays(
        T_world_origin, points, CAMERA.project(transform_points(T_cam_origin, points))
    )


def on_rays(T_world_origin, points_origin, xy, covariance=(1.0, 0.0, 1.0), min_depth=MIN_DEPTH):
    num = len(points_origin)
    return RayObservations(
        origin=np.repeat(T_world_origin[:3, 3:], num, axis=1),
        direction=T_world_origin[:3, :3] @ (points_origin / points_origin[:, 2:]).T,
        min_depth=np.full(num, min_depth),
        observed=(xy - (CAMERA.cx, CAMERA.cy)).T,
        covariance=np.repeat(np.asarray(covariance, float)[:, None], num, axis=1),
        gate=np.full(num, 3.0),
    )


@pytest.mark.parametrize("seed", range(5))
def test_true_poses_have_no_residual_whatever_the_depths(seed):
    T, rays = seen_by_two(seed)
    assert rays.sizes(CAMERA, T).max() < 1e-6
    further = T.copy()
    further[:3, 3] = (T @ np.append(rays.origin[:, 0], 1.0))[:3] * 1.7 - T[:3, :3] @ rays.origin[:, 0]
    assert rays.sizes(CAMERA, further).max() < 1e-6, "a way that is longer makes all depths larger"


@pytest.mark.parametrize("seed", range(4))
def test_the_gradient_is_that_of_the_cost(seed):
    T, rays = seen_by_two(seed)
    rays.observed[:] += np.random.default_rng(seed).normal(0, 2.0, rays.observed.shape)

    def cost(twist):
        return 0.5 * (rays.sizes(CAMERA, exp_se3(twist) @ T) ** 2).sum()

    # With a tolerance this wide nothing is weighted down, and the cost is a plain sum of squares.
    _, gradient = rays.normal_equations(CAMERA, T, 1e6, None)
    numeric = [(cost(-1e-6 * axis) - cost(1e-6 * axis)) / 2e-6 for axis in np.eye(6)]
    assert np.abs(gradient - numeric).max() < 1e-4 * np.abs(numeric).max()


def test_beyond_the_ends_of_a_ray_the_way_along_it_counts():
    sideways = make_transform(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    points = np.array([[0.0, 0.0, 5.0]] * 4)
    # Infinitely far the point is at 320; at a depth of 1 it is 500 to the left.
    xy = np.array([[330.0, 240.0], [320.0, 240.0], [-180.0, 240.0], [-200.0, 243.0]])
    rays = on_rays(np.eye(4), points, xy)
    assert np.allclose(rays.sizes(CAMERA, sideways), [10.0, 0.0, 0.0, np.hypot(20.0, 3.0)])


def test_a_camera_that_goes_ahead_has_passed_what_is_nearer():
    ahead = make_transform(np.eye(3), np.array([0.0, 0.0, -2.0]))
    points = np.array([[0.5, 0.0, 5.0]] * 3)
    # Infinitely far the point is at 370; at a depth of 3 in the other camera it is at 1 in this one, at 470.
    xy = np.array([[321.0, 240.0], [420.0, 240.0], [500.0, 240.0]])
    assert np.allclose(on_rays(np.eye(4), points, xy).sizes(CAMERA, ahead), [49.0, 0.0, 30.0])


def test_a_track_next_to_where_the_camera_goes_does_not_rule_its_way():
    ahead = make_transform(np.eye(3), np.array([0.0, 0.0, -2.0]))
    points = np.array([[x, 0.0, 5.0] for x in (1.0, 1e-3, 1e-6)])
    # Thirty pixels from there, which of the three only the first one could be.
    rays = on_rays(np.eye(4), points, np.array([[350.0, 240.0]] * 3))
    assert np.allclose(rays.sizes(CAMERA, ahead), [70.0, 29.7, 30.0], atol=0.1)
    for row in range(3):
        one = on_rays(np.eye(4), points[row : row + 1], np.array([[350.0, 240.0]]))
        hessian, _ = one.normal_equations(CAMERA, ahead, 1e6, None)
        assert hessian[3:, 3:].max() < (500.0 / MIN_DEPTH) ** 2, "as of a point at the least depth"


def test_points_behind_the_camera_are_off_by_anything():
    T, rays = seen_by_two(0)
    back = make_transform(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3)) @ T
    assert np.isinf(rays.sizes(CAMERA, back)).all()
    hessian, gradient = rays.normal_equations(CAMERA, back, 1.0, None)
    assert not hessian.any()
    assert not gradient.any()


@pytest.mark.parametrize(
    ("ray", "T_cam_origin", "distance"),
    [
        ((0.0, 0.0, 1.0), make_transform(np.eye(3), np.array([0.0, 0.0, -1.5])), 5.0),
        ((1.0, 0.0, 0.0), np.eye(4), np.inf),
    ],
    ids=["where the camera goes, past its nearest point", "along the plane of the camera"],
)
def test_rays_that_are_a_point_or_nowhere_have_finite_derivatives(ray, T_cam_origin, distance):
    rays = on_rays(np.eye(4), np.array([[0.0, 0.0, 1.0]]), np.array([[325.0, 240.0]]))
    rays.direction[:, 0] = ray
    assert np.allclose(rays.sizes(CAMERA, T_cam_origin), distance)
    assert all(np.isfinite(part).all() for part in rays.normal_equations(CAMERA, T_cam_origin, 1.0, None))


def test_an_error_counts_by_how_well_the_observation_is_known_across_the_line():
    sideways = make_transform(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    points, xy = np.array([[0.0, 0.0, 5.0]]), np.array([[220.0, 242.0]])
    for covariance, expected in (((9.0, 0.0, 1.0), 2.0), ((1.0, 0.0, 16.0), 0.5)):
        sizes = on_rays(np.eye(4), points, xy, covariance).sizes(CAMERA, sideways)
        assert np.allclose(sizes, expected)


def test_a_camera_that_only_turns_is_told_how_far_without_any_depth():
    rng = np.random.default_rng(3)
    turn = make_transform(exp_so3(np.array([0.03, -0.05, 0.02])), np.zeros(3))
    T, rays = seen_by_two(3, T_world_origin=np.eye(4), T_cam_origin=turn)
    few = rng.uniform((-3, -2, 4), (3, 2, 12), (4, 3))
    xy = CAMERA.project(transform_points(T, few))
    sigma = np.ones(4)
    found = refine_pose(CAMERA, np.eye(4), few, xy, sigma, 3.0 * sigma, rays=rays)
    assert np.abs(found.T_cam_world - T).max() < 1e-6
    # The camera is exactly where the other one was: the piece of a line is a point.
    assert rays.sizes(CAMERA, T).max() < 1e-6
    hessian, _ = rays.normal_equations(CAMERA, T, 1.0, None)
    assert np.linalg.eigvalsh(hessian[:3, :3])[0] > 1e5, "all three axes are held"


def test_outliers_are_weighted_down_and_left_out():
    T, rays = seen_by_two(1)
    rays.observed[:, :20] += np.random.default_rng(1).uniform(-60, 60, (2, 20))
    few = np.random.default_rng(2).uniform((-3, -2, 4), (3, 2, 12), (40, 3))
    points = transform_points(invert_transform(T), few)
    sigma = np.ones(40)
    start = exp_se3(np.full(6, 0.004)) @ T
    found = refine_pose(CAMERA, start, points, CAMERA.project(few), sigma, 3.0 * sigma, rays=rays)
    assert rotation_angle_deg(found.T_cam_world[:3, :3] @ T[:3, :3].T) < 1e-3
    agreeing = rays.sizes(CAMERA, found.T_cam_world) < 3.0
    assert agreeing[20:].all()
    assert agreeing[:20].mean() < 0.5, "a few lie on their lines by chance"
