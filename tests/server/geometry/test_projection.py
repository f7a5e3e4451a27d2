import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, transform_points
from semcast.server.geometry.projection import MIN_DEPTH_MAP, depths_in, project_in_front

CAMERA = Intrinsics(fx=500, fy=480, cx=320, cy=240, width=640, height=480)


def test_depth_is_the_third_coordinate_in_the_camera():
    rng = np.random.default_rng(0)
    xyz = rng.normal(0.0, 3.0, (20, 3))
    T_cam_world = exp_se3(rng.normal(0.0, 1.0, 6))
    assert np.allclose(depths_in(T_cam_world, xyz), transform_points(T_cam_world, xyz)[:, 2])


def test_each_point_may_have_a_camera_of_its_own():
    rng = np.random.default_rng(1)
    xyz = rng.normal(0.0, 3.0, (5, 3))
    T_cam_world = np.stack([exp_se3(rng.normal(0.0, 1.0, 6)) for _ in xyz])
    expected = [depths_in(T, point[None])[0] for T, point in zip(T_cam_world, xyz, strict=True)]
    assert np.allclose(depths_in(T_cam_world, xyz), expected)


def test_a_camera_that_sees_no_point_has_no_depth():
    assert depths_in(np.eye(4), np.zeros((0, 3))).shape == (0,)
    assert depths_in(np.zeros((0, 4, 4)), np.zeros((0, 3))).shape == (0,)


def test_points_in_front_are_where_the_camera_has_them_and_all_pixels_are_finite():
    points = np.array([[0.5, -0.5, 2.0], [0.5, -0.5, -2.0], [1.0, 1.0, 0.0], [1.0, 1.0, 0.5 * MIN_DEPTH_MAP]])
    xy, front = project_in_front(CAMERA, points)
    assert front.tolist() == [True, False, False, False]
    assert xy[0].tolist() == [320 + 500 * 0.25, 240 - 480 * 0.25]
    assert np.isfinite(xy).all()
