"""Accuracy and completeness of clouds, of walls whose distances are known."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, transform_points
from semcast.evaluation.cloud_error import TrueView, _distance_between, cloud_error, distance_from
from semcast.evaluation.scenes.surfaces import Surface, exact_depth

CAMERA = Intrinsics(fx=80.0, fy=80.0, cx=79.5, cy=59.5, width=160, height=120)
T_WORLD_CAM = make_transform(exp_so3([0.1, -0.3, 0.2]), [3.0, -2.0, 1.0])


def wall(z_m=4.0, half_m=50.0):
    """A square across the view of the camera at the world's origin."""
    corner = np.array([-half_m, -half_m, z_m])
    along, down = 2 * half_m * np.eye(3)[:2]
    return Surface(corner, along, down, [np.zeros((2, 2, 3), np.float32)])


def seen(*surfaces, T_world_cam=None):
    T = np.eye(4) if T_world_cam is None else T_world_cam
    return TrueView(T, CAMERA, exact_depth(surfaces, CAMERA, T), surfaces)


def points_of(view, factor=1.0):
    """Every pixel's point ``(N, 3)`` in the camera frame, so many times as far."""
    rows, columns = np.nonzero(np.isfinite(view.depth))
    z = factor * view.depth[rows, columns].astype(np.float64)
    return z[:, None] * CAMERA.unproject(np.column_stack([columns, rows]))


def test_distances_from_a_rectangle_by_hand():
    xyz = np.array([[0.0, 0.0, 4.5], [0.3, -0.2, 4.0], [4.0, 5.0, 4.0], [1.0, 4.0, 8.0]])
    near = wall(half_m=1.0)
    np.testing.assert_allclose(distance_from([near], xyz), [0.5, 0.0, 5.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(distance_from([near, wall(z_m=8.0)], xyz), [0.5, 0.0, 4.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("T_world_cam", [np.eye(4), T_WORLD_CAM])
def test_points_beyond_a_wall_are_off_by_their_share(T_world_cam):
    surface = wall()
    moved = Surface(
        transform_points(T_world_cam, surface.corner_m[None])[0],
        T_world_cam[:3, :3] @ surface.edge_u_m,
        T_world_cam[:3, :3] @ surface.edge_v_m,
        surface.texture,
    )
    view = seen(moved, T_world_cam=T_world_cam)
    exact, off, far = (cloud_error([{7: points_of(view, factor)}], {7: view}) for factor in (1.0, 1.01, 1.05))
    assert exact["points"] == 160 * 120
    assert exact["accuracy_p90"] < 1e-5
    assert exact["completeness"] == 1.0
    assert off["accuracy_median"] == pytest.approx(0.01 / 1.01, rel=1e-3)
    assert (off["completeness"], far["completeness"]) == (1.0, 0.0)
    assert far["accuracy_p90"] == pytest.approx(0.05 / 1.05, rel=1e-3)


def test_what_no_point_is_near_is_not_covered_and_what_is_not_there_need_not_be():
    half = seen(wall(z_m=4.0, half_m=2.0))  # 80 of 160 columns and 80 of 120 rows
    points = points_of(half)
    left = points[points[:, 0] < 0]
    one, both = cloud_error([{1: left}], {1: half}), cloud_error([{1: left}, {1: points}], {1: half})
    assert one["completeness"] == pytest.approx(0.5, abs=0.06)
    assert both["completeness"] == pytest.approx(0.5 * (1 + one["completeness"]))
    assert both["points"] == (len(left) + len(points)) / 2


def test_what_one_keyframe_saw_another_may_cover():
    first, second = seen(wall()), seen(wall(), T_world_cam=make_transform(np.eye(3), [0.4, 0.0, 0.0]))
    figures = cloud_error([{1: points_of(first)}], {1: first, 2: second})
    assert 0.9 < figures["completeness"] < 1.0


def test_a_cloud_without_points_covers_nothing():
    empty = {"points": 0.0, "accuracy_median": None, "accuracy_p90": None, "completeness": 0.0}
    assert cloud_error([{}], {1: seen(wall())}) == empty
    assert cloud_error([{1: np.zeros((0, 3), np.float32)}], {1: seen(wall())}) == empty


def test_of_an_empty_world_there_is_nothing_to_cover():
    nothing = {1: seen(wall(z_m=-4.0))}
    for points in (np.zeros((0, 3), np.float32), np.ones((5, 3), np.float32)):
        figures = cloud_error([{1: points}], nothing)
        assert (figures["points"], figures["completeness"]) == (len(points), None)


def test_the_nearest_points_are_exact(rng):
    xyz, places = rng.normal(size=(2000, 3)), rng.normal(size=(300, 3))
    np.testing.assert_allclose(_distance_between(places, xyz), cKDTree(xyz).query(places)[0], rtol=1e-5)
