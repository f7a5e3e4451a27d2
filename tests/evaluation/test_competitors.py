import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, transform_points
from semcast.evaluation.competitors import COMPETITORS, CompetitorSettings
from semcast.evaluation.pose_error import relative_pose_error

CAMERA = Intrinsics(fx=500, fy=510, cx=320, cy=235, width=640, height=480)
T_CAM1_CAM0 = make_transform(exp_so3([0.02, 0.05, -0.01]), [0.5, 0.1, 0.05])


@pytest.fixture
def matches(rng):
    points_cam0 = rng.uniform([-3, -2, 4], [3, 2, 10], (200, 3))
    xy0 = CAMERA.project(points_cam0)
    xy1 = CAMERA.project(transform_points(T_CAM1_CAM0, points_cam0)) + rng.normal(0, 0.3, (200, 2))
    xy1[:60] = rng.uniform([0, 0], [640, 480], (60, 2))
    return xy0, xy1


@pytest.mark.parametrize("name", COMPETITORS)
def test_the_pose_is_found_among_outliers(name, matches):
    error = relative_pose_error(COMPETITORS[name](*matches, CAMERA, CompetitorSettings()), T_CAM1_CAM0)
    assert error.rot_deg < 1.0
    assert error.tdir_deg < 8.0


@pytest.mark.parametrize("name", COMPETITORS)
def test_the_same_seed_gives_the_same_pose(name, matches):
    first, second = (COMPETITORS[name](*matches, CAMERA, CompetitorSettings(seed=3)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("name", COMPETITORS)
def test_too_few_or_degenerate_matches_give_none_or_a_pose_and_never_raise(name):
    assert COMPETITORS[name](np.zeros((4, 2)), np.zeros((4, 2)), CAMERA, CompetitorSettings()) is None
    same = np.tile([[100.0, 100.0]], (20, 1))
    pose = COMPETITORS[name](same, same, CAMERA, CompetitorSettings())
    assert pose is None or (pose.shape == (4, 4) and np.isfinite(pose).all())


@pytest.mark.parametrize("name", COMPETITORS)
def test_points_far_away_for_the_baseline_count(name, rng):
    # Depths of 80 to 200 baselines, as between neighbouring frames.
    T = make_transform(exp_so3([0.0, 0.002, 0.0]), [0.05, 0.0, 0.0])
    points_cam0 = rng.uniform([-3, -2, 4], [3, 2, 10], (400, 3))
    points_cam1 = transform_points(T, points_cam0)
    pose = COMPETITORS[name](
        CAMERA.project(points_cam0), CAMERA.project(points_cam1), CAMERA, CompetitorSettings()
    )
    assert relative_pose_error(pose, T).tdir_deg < 20.0
