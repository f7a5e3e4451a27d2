import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform, transform_points
from semcast.server.geometry.triangulation import mean_centre, triangulate

CAMERA = Intrinsics(fx=500, fy=480, cx=320, cy=240, width=640, height=480)


def make_views(rng, num_views=4, num_points=50, step=0.4):
    poses = [
        make_transform(exp_so3(rng.normal(0, 0.03, 3)), (step * k, 0.1 * rng.normal(), 0.1 * k))
        for k in range(num_views)
    ]
    T_cam_world = invert_transform(np.stack(poses))
    points = rng.uniform((-2, -1.5, 5), (2, 1.5, 12), (num_points, 3))
    xy = np.stack([CAMERA.project(transform_points(T, points)) for T in T_cam_world])
    view, point = np.meshgrid(np.arange(num_views), np.arange(num_points), indexing="ij")
    return T_cam_world, points, view.ravel(), point.ravel(), xy.reshape(-1, 2)


@pytest.mark.parametrize("num_views", [2, 3, 6])
def test_exact_rays_meet_in_the_points(num_views):
    T_cam_world, points, view, point, xy = make_views(np.random.default_rng(num_views), num_views)
    found = triangulate(CAMERA, T_cam_world, view, point, xy, np.ones(len(xy)), len(points))
    assert np.allclose(found.xyz, points, atol=1e-6)
    assert found.in_front.all()
    assert found.error_sigma.max() < 1e-6


def test_parallax_by_hand():
    # Two cameras 2 apart look at a point 1 ahead of their middle: 90 degrees.
    T_cam_world = invert_transform(np.stack([make_transform(np.eye(3), (x, 0, 0)) for x in (-1.0, 1.0)]))
    xy = np.concatenate([CAMERA.project([[1.0, 0, 1]]), CAMERA.project([[-1.0, 0, 1]])])
    found = triangulate(CAMERA, T_cam_world, np.array([0, 1]), np.zeros(2, int), xy, np.ones(2), 1)
    assert found.parallax_deg[0] == pytest.approx(90.0)
    assert np.allclose(found.xyz, [[0, 0, 1]], atol=1e-9)


def test_weighted_error_is_smaller_than_that_of_equal_weights():
    errors = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T_cam_world, points, view, point, xy = make_views(rng, 5)
        sigma = np.where(view % 2, 0.2, 3.0)
        xy = xy + rng.normal(0, 1, xy.shape) * sigma[:, None]
        errors.append(
            [
                np.linalg.norm(
                    triangulate(CAMERA, T_cam_world, view, point, xy, s, len(points)).xyz - points, axis=1
                ).mean()
                for s in (sigma, np.ones(len(xy)))
            ]
        )
    ours, equal = np.mean(errors, axis=0)
    assert ours < 0.5 * equal


def test_error_is_counted_in_sigmas():
    rng = np.random.default_rng(0)
    T_cam_world, points, view, point, xy = make_views(rng, 8, 200)
    xy = xy + rng.normal(0, 0.5, xy.shape)
    found = triangulate(CAMERA, T_cam_world, view, point, xy, np.full(len(xy), 0.5), len(points))
    # 16 residuals of which 3 are fitted away.
    assert np.sqrt((found.error_sigma**2).mean()) == pytest.approx(np.sqrt(13 / 16), rel=0.05)


def test_a_point_behind_is_not_in_front():
    # Rays that diverge meet behind the cameras.
    T_cam_world = invert_transform(np.stack([make_transform(np.eye(3), (x, 0, 0)) for x in (0.0, 1.0)]))
    xy = np.array([[300.0, 240], [340.0, 240]])
    found = triangulate(CAMERA, T_cam_world, np.array([0, 1]), np.zeros(2, int), xy, np.ones(2), 1)
    assert not found.in_front[0]


def test_one_view_and_equal_rays_give_no_parallax():
    T_cam_world = np.stack([np.eye(4)] * 2)
    xy = np.array([[300.0, 240], [300.0, 240], [100.0, 100]])
    found = triangulate(CAMERA, T_cam_world, np.array([0, 1, 0]), np.array([0, 0, 1]), xy, np.ones(3), 3)
    assert np.isfinite(found.xyz).all()
    assert np.all(found.parallax_deg < 1e-3)
    assert not found.in_front[1]
    assert not found.in_front[2]


def test_no_observations_give_no_points():
    none = np.zeros(0, int)
    for num_points in (0, 2):
        found = triangulate(CAMERA, np.eye(4)[None], none, none, np.zeros((0, 2)), np.zeros(0), num_points)
        assert found.xyz.shape == (num_points, 3)
        assert not found.in_front.any()


def slid(xy, along, rng, *, along_px=2.0, across_px=0.1):
    """Observations that slid along edges, and the edges that say so."""
    across = np.column_stack([-along[:, 1], along[:, 0]])
    moved = (
        xy + along * rng.normal(0, along_px, (len(xy), 1)) + across * rng.normal(0, across_px, (len(xy), 1))
    )
    return moved, 0.5 * np.log(along_px / across_px) * along


def test_points_that_slid_along_upright_edges_have_their_depth():
    rng = np.random.default_rng(0)
    T_cam_world, points, view, point, exact = make_views(rng, 5)  # the camera goes to the right
    xy, edge = slid(exact, np.tile([0.0, 1.0], (len(exact), 1)), rng)
    sigma = np.full(len(xy), np.sqrt(0.2))
    shaped, alike = (
        triangulate(CAMERA, T_cam_world, view, point, xy, sigma, len(points), edge=e) for e in (edge, None)
    )
    depth_error = [np.median(np.abs(found.xyz - points)[:, 2]) for found in (shaped, alike)]
    assert depth_error[0] < 0.6 * depth_error[1]
    assert 0.7 < np.median(shaped.error_sigma) < 1.2
    assert np.median(alike.error_sigma) > 2.0


def test_parallax_along_an_edge_hardly_counts():
    _, points, view, point, _ = make_views(np.random.default_rng(1), 3)
    T_cam_world = invert_transform(np.stack([make_transform(np.eye(3), (0.4 * k, 0, 0)) for k in range(3)]))
    xy = np.concatenate([CAMERA.project(transform_points(T, points)) for T in T_cam_world])
    how = (CAMERA, T_cam_world, view, point, xy, np.ones(len(xy)), len(points))
    free = triangulate(*how).parallax_deg
    length = 0.5 * np.log(10.0)
    lying = triangulate(*how, edge=np.tile([length, 0.0], (len(xy), 1))).parallax_deg
    upright = triangulate(*how, edge=np.tile([0.0, length], (len(xy), 1))).parallax_deg
    assert np.allclose(lying, free / np.sqrt(10.0)), "the camera goes along them"
    assert np.allclose(upright, free), "and across these, which is not worth more than at a corner"


def test_the_mean_centre_is_that_of_a_point_s_own_views():
    centre = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 2.0], [0.0, 5.0, 0.0]])
    mean = mean_centre(centre, np.array([0, 0, 2]), 3)
    np.testing.assert_array_equal(mean, [[2.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
