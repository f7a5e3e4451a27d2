"""What residuals of an adjustment say about focal length and distortion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from shaken_views import CAMERA, adjusted

from semcast.server.mapping.lens import believed_lens, fit_lens
from semcast.server.mapping.residual_patterns import FOCAL, RADIAL, RESIDUAL, _lens_patterns, grouped, spread


@pytest.mark.parametrize("factor", [0.97, 1.02])
def test_a_focal_length_that_is_wrong_is_found_in_what_an_adjustment_leaves(factor):
    camera = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    fit = fit_lens(adjusted(camera).pattern_products, num_radial=0)
    assert fit.focal == pytest.approx(factor - 1.0, abs=0.004)  # one step of what is no straight line
    assert fit.radial == fit.sigma_radial == (0.0, 0.0)
    assert fit.sigma_focal < 0.003
    assert fit.explained > 0.05


def test_distortion_is_told_from_focal_length():
    camera = replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy)
    fit = fit_lens(adjusted(camera, radial=-0.05).pattern_products, num_radial=1)
    assert fit.radial[0] == pytest.approx(-0.05, abs=0.01)
    assert fit.focal == pytest.approx(0.01, abs=0.003)
    assert fit.sigma_radial[0] < 0.01


def test_the_second_coefficient_is_told_from_the_first():
    views = adjusted(CAMERA, radial=-0.1, radial_2=0.2).pattern_products
    fit = believed_lens(views)
    assert fit == fit_lens(views, num_radial=2)
    assert fit.radial == pytest.approx((-0.1, 0.2), abs=0.03)
    assert max(fit.sigma_radial) < 0.03
    assert abs(fit.focal) < 0.005
    # Once both are believed in they are asked for to the end, whatever they explain.
    right = adjusted(CAMERA).pattern_products
    assert believed_lens(right).sigma_radial == (0.0, 0.0)
    assert believed_lens(right, 2) == fit_lens(right, num_radial=2)


def test_the_principal_point_is_found_once_the_rest_is_near():
    moved = replace(CAMERA, cx=CAMERA.cx + 8.0, cy=CAMERA.cy - 4.0)
    views = adjusted(moved).pattern_products
    fit = believed_lens(views)
    assert fit == fit_lens(views, num_radial=0, with_centre=True)
    assert fit.centre == pytest.approx((8.0 / CAMERA.fx, -4.0 / CAMERA.fy), abs=0.004)
    assert max(fit.sigma_centre) < 0.004
    far = adjusted(replace(moved, fx=1.12 * CAMERA.fx, fy=1.12 * CAMERA.fy)).pattern_products
    assert believed_lens(far).centre == (0.0, 0.0)
    assert believed_lens(far, with_centre=True).centre != (0.0, 0.0)


@pytest.mark.parametrize("distortion", [(), (-0.28, 0.07, 0.001, -0.002)])
def test_patterns_are_how_pixels_change_with_the_lens(distortion):
    """By differences: a pixel stays, and is seen through a slightly other lens."""
    camera = replace(CAMERA, fy=1.1 * CAMERA.fx)
    ray = np.array([[0.4, 0.3], [-0.35, 0.2], [0.1, -0.3], [0.0, 0.0]])
    distorted = np.array(distortion or np.zeros(4))

    def lens_of(change):
        focal, k1, k2, x, y = change
        fx, fy = camera.fx * (1.0 + focal), camera.fy * (1.0 + focal)
        cx, cy = camera.cx + x * camera.fx, camera.cy + y * camera.fy
        same_px = (1.0 + focal) ** np.array([2, 4, 1, 1])
        k = (distorted + np.array([k1, k2, 0, 0])) * same_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), k

    K, k = lens_of(np.zeros(5))
    points, still = np.column_stack([ray, np.ones(4)]), np.zeros(3)
    pixels = cv2.projectPoints(points, still, still, K, k)[0]

    def residual(change):
        K, k = lens_of(change)
        done = (cv2.TERM_CRITERIA_COUNT, 200, 0.0)
        straight = cv2.undistortPoints(pixels, K, k, P=K, criteria=done).reshape(-1, 2)
        return ray @ K[:2, :2].T + K[:2, 2] - straight

    patterns = _lens_patterns((camera.fx, camera.fy), distortion, ray)
    for pattern, step in zip(patterns, 1e-5 * np.eye(5), strict=True):
        by_differences = (residual(step) - residual(-step)) / 2e-5
        np.testing.assert_allclose(pattern, by_differences, rtol=1e-3, atol=1e-2)


def test_a_lens_that_is_right_is_left_alone():
    fit = fit_lens(adjusted(CAMERA).pattern_products, num_radial=1)
    assert abs(fit.focal) < 4 * fit.sigma_focal < 0.012
    assert abs(fit.radial[0]) < 4 * fit.sigma_radial[0] < 0.02
    assert fit.explained < 0.01


def test_distortion_is_believed_where_it_explains_more():
    far = replace(CAMERA, fx=1.06 * CAMERA.fx, fy=1.06 * CAMERA.fy)
    straight, bent = adjusted(far).pattern_products, adjusted(far, radial=-0.1).pattern_products
    assert believed_lens(straight) == fit_lens(straight, num_radial=0)
    fit = believed_lens(bent)
    assert fit == fit_lens(bent, num_radial=1)
    # In the units of the focal length that was believed in.
    assert fit.radial[0] == pytest.approx(-0.1 / 1.06**2, abs=0.02)
    assert fit.focal == pytest.approx(0.06, abs=0.01)
    assert believed_lens(np.zeros((9, 9, 9))) is None


def test_by_hand_the_change_is_the_slope_and_its_spread_that_of_what_is_left():
    # A doubled focal length would move the points of a view by 10 in all; they are off by .012 of that.
    def view(slope):
        told = np.zeros((9, 9))
        told[RESIDUAL, RESIDUAL], told[FOCAL, FOCAL] = 4.0, 100.0
        told[RESIDUAL, FOCAL] = told[FOCAL, RESIDUAL] = 100.0 * slope
        return told

    fit = fit_lens([view(0.012)] * 4, num_radial=0)
    assert fit.focal == pytest.approx(0.012)
    assert fit.sigma_focal == pytest.approx(0.0, abs=1e-12)
    assert fit.explained == pytest.approx(0.012**2 * 100.0 / 4.0)
    assert fit.unit == pytest.approx((np.sqrt(4.0 / 100.0), 0.0, 0.0, 0.0, 0.0))
    # Leaving one of 1, 2, 3 out leaves means of 2.5, 2, 1.5: the jackknife has the error of the mean.
    fit = fit_lens([view(0.01), view(0.02), view(0.03)], num_radial=0)
    assert fit.sigma_focal == pytest.approx(0.01 / np.sqrt(3))
    assert spread(np.array([2.5, 2.0, 1.5])) == pytest.approx(1 / np.sqrt(3))


def test_a_unit_of_change_doubles_the_squared_residuals_the_others_following():
    views = adjusted(CAMERA, radial=-0.05).pattern_products
    fit, total = fit_lens(views, num_radial=1), grouped(views).sum(axis=0)
    at = [FOCAL, RADIAL]
    for k, other in ((0, 1), (1, 0)):
        moved = np.zeros(2)
        moved[k] = fit.unit[k]
        moved[other] = -total[at[0], at[1]] * moved[k] / total[at[other], at[other]]
        more = moved @ total[np.ix_(at, at)] @ moved
        assert more == pytest.approx(total[RESIDUAL, RESIDUAL], rel=1e-4)
    assert fit.unit[2:] == (0.0, 0.0, 0.0)


def test_views_that_say_nothing_are_no_lens():
    assert fit_lens(np.zeros((0, 9, 9)), num_radial=1) is None
    assert fit_lens(np.zeros((9, 9, 9)), num_radial=1) is None
    flat = np.zeros((4, 9, 9))
    flat[:, RESIDUAL, RESIDUAL] = 1.0
    assert fit_lens(flat, num_radial=0) is None
    assert grouped(flat).shape == (4, 9, 9)


def test_one_view_that_says_all_leaves_a_fit_without_it_that_says_nothing():
    silent = np.zeros((9, 9))
    silent[RESIDUAL, RESIDUAL] = 1.0
    telling = 2.0 * np.eye(9)
    telling[RESIDUAL, FOCAL] = telling[FOCAL, RESIDUAL] = 0.1
    fit = fit_lens([telling, silent, silent], num_radial=1)
    assert fit.focal == pytest.approx(0.05)
    assert fit.radial[0] == pytest.approx(0.0)
