"""What residuals of an adjustment say about a rolling shutter."""

from dataclasses import replace

import numpy as np
import pytest
from shaken_views import CAMERA, NUM_VIEWS, SIZE_WH, adjusted, pose_at, rolling_xy

from semcast.common.geometry import exp_se3, invert_transform, transform_points
from semcast.server.mapping.bundle_problem import ViewMotion
from semcast.server.mapping.readout import Readout, body_velocity, fit_readout, lean
from semcast.server.mapping.residual_patterns import RESIDUAL, ROWS, pattern_products_of


@pytest.mark.parametrize("readout_from", ["top", "bottom", "left", "right"])
def test_the_readout_and_its_side_are_found_in_what_an_adjustment_leaves(readout_from):
    result = adjusted(replace(CAMERA, readout_ms=20.0, readout_from=readout_from))
    assert result.pattern_products.shape == (NUM_VIEWS, 9, 9)
    fit = fit_readout(result.pattern_products)
    assert fit.readout.side == readout_from
    assert fit.readout.ms == pytest.approx(20.0, abs=1.5)
    assert fit.sigma_ms < 1.5
    assert fit.explained > 0.5


def test_noise_alone_looks_like_no_rolling_shutter():
    fit = fit_readout(adjusted(CAMERA).pattern_products)
    assert fit.readout.ms < 4 * max(fit.sigma_ms, 0.05)
    assert fit.readout.ms < 1.0
    assert fit.explained < 0.01


@pytest.mark.parametrize("put_right", [0.0, 0.8, 1.1])
def test_all_of_the_readout_is_found_however_much_images_were_put_right_for(put_right):
    result = adjusted(replace(CAMERA, readout_ms=20.0), put_right=put_right)
    fit = fit_readout(result.pattern_products)
    assert fit.readout.signed_ms == pytest.approx(20.0, abs=0.25)
    untold = replace(result.problem.motion, put_right_px=None)
    told = pattern_products_of(result.problem, untold, result.T_world_cam, result.xyz, result.residual_px)
    assert fit_readout(told).readout.signed_ms == pytest.approx(20.0 * (1.0 - put_right), abs=0.25)


def test_an_axis_that_is_known_is_kept():
    views = adjusted(replace(CAMERA, readout_ms=20.0, readout_from="bottom")).pattern_products
    assert fit_readout(views, "rows") == fit_readout(views)
    across = fit_readout(views, "columns")
    assert across.readout.axis == "columns"
    assert across.readout.ms < 2.0


def test_without_movement_nothing_is_said():
    assert adjusted(CAMERA, velocities=False).pattern_products is None
    result = adjusted(CAMERA)
    motion = ViewMotion(SIZE_WH, np.full((NUM_VIEWS, 6), np.nan))
    told = pattern_products_of(result.problem, motion, result.T_world_cam, result.xyz, result.residual_px)
    assert not told.any()
    assert fit_readout(told) is None
    assert fit_readout(np.zeros((0, 9, 9))) is None
    still = replace(motion, velocity=np.zeros((NUM_VIEWS, 6)))
    told = pattern_products_of(result.problem, still, result.T_world_cam, result.xyz, result.residual_px)
    assert fit_readout(told) is None


def test_a_velocity_is_the_twist_between_two_poses():
    T_world_cam, twist = pose_at(0.3), np.array([0.2, -0.1, 0.3, 1.0, -2.0, 0.5])
    around = np.array([T_world_cam @ exp_se3(s * twist) for s in (-0.005, 0.005)])
    np.testing.assert_allclose(
        body_velocity(T_world_cam, around, np.array([-0.005, 0.005])), twist, atol=1e-4
    )


def test_by_hand_a_camera_that_nods_stretches_its_image():
    # Turning about x moves the middle of the image by fy a radian, whatever the depth. A row read 5 ms late,
    # a quarter of 20, at 0.1 rad/s sees points moved by 400 * 0.1 * 0.005 = 0.2 px.
    camera = replace(CAMERA, readout_ms=20.0)
    point = np.array([[0.0, 0.25 * 479 / 400.0, 1.0]])
    np.testing.assert_allclose(camera.project(point), [[319.5, 239.5 + 0.25 * 479]])
    flow = np.array([[0.0, -40.0]])
    by_pose = lean(camera, np.repeat(point, 3, axis=0), np.repeat(flow, 3, axis=0))
    moved = camera.project(transform_points(invert_transform(exp_se3(by_pose)), point)) - camera.project(
        point
    )
    np.testing.assert_allclose(moved, [[0.0, -0.2]], atol=1e-3)


def test_a_pose_without_its_lean_is_that_of_the_middle_row():
    camera = replace(CAMERA, readout_ms=20.0)
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (200, 2)), rng.uniform(3.0, 5.0, 200)])
    t_s, ms = 0.25, 1e-3
    xyz = transform_points(pose_at(t_s), points)
    flow = (rolling_xy(xyz, t_s + ms, CAMERA) - rolling_xy(xyz, t_s - ms, CAMERA)) / (2 * ms)
    seen = rolling_xy(xyz, t_s, camera)
    twist = np.zeros(6)
    for _ in range(10):  # the pose that fits what was seen, by Gauss-Newton on differences
        base = camera.project(transform_points(invert_transform(exp_se3(twist)), points))
        step = 1e-6
        jacobian = np.stack(
            [
                (
                    camera.project(transform_points(invert_transform(exp_se3(twist + d)), points)) - base
                ).ravel()
                for d in step * np.eye(6)
            ],
            axis=1,
        )
        twist += np.linalg.lstsq(jacobian / step, (seen - base).ravel(), rcond=None)[0]
    off = lean(camera, points, flow)
    assert np.linalg.norm(twist[:3]) > 1e-4
    assert np.linalg.norm(twist - off) < 0.15 * np.linalg.norm(twist)


def test_a_readout_has_a_side_and_goes_with_a_camera():
    readout = Readout("columns", -12.5)
    assert (readout.ms, readout.side, str(readout)) == (12.5, "right", "12.5 ms from right")
    camera = readout.put_on(CAMERA)
    assert (camera.readout_ms, camera.readout_from) == (12.5, "right")
    assert Readout.of(camera) == readout
    assert Readout.of(CAMERA) == Readout("rows", 0.0)
    assert readout.with_more(Readout("columns", 2.5)) == Readout("columns", -10.0)
    assert Readout("rows", 0.0).with_more(readout) == readout
    assert Readout("rows", 250.0).put_on(CAMERA).readout_ms == 100.0


def test_by_hand_the_readout_is_the_slope_and_its_spread_that_of_what_is_left():
    # A readout of a second would move the points of a view by 10 in all; they are off by .02 of that.
    def view(slope):
        told = np.zeros((9, 9))
        told[RESIDUAL, RESIDUAL], told[ROWS, ROWS] = 4.0, 100.0
        told[RESIDUAL, ROWS] = told[ROWS, RESIDUAL] = 100.0 * slope
        return told

    fit = fit_readout([view(0.01), view(0.02), view(0.03)])
    assert (fit.readout.axis, fit.readout.signed_ms) == ("rows", pytest.approx(20.0))
    assert fit.explained == pytest.approx(0.02**2 * 100.0 / 4.0)
    # Leaving one of 10, 20, 30 out leaves means of 25, 20, 15: the jackknife has the error of the mean.
    assert fit.sigma_ms == pytest.approx(10.0 / np.sqrt(3))
    assert fit.unit_ms == pytest.approx(1e3 * np.sqrt(4.0 / 100.0)), "as much more of the squares as there is"
