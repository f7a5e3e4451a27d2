"""What residuals of an adjustment say about focal length and distortion."""

from dataclasses import replace

import numpy as np
import pytest
from shaken_views import CAMERA, adjusted

from semcast.server.mapping.left_over import FOCAL, RESIDUAL, grouped, spread
from semcast.server.mapping.lens import believed_lens, fit_lens


@pytest.mark.parametrize("factor", [0.97, 1.02])
def test_a_focal_length_that_is_wrong_is_found_in_what_an_adjustment_leaves(factor):
    camera = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    fit = fit_lens(adjusted(camera).left_over, num_radial=0)
    assert fit.focal == pytest.approx(factor - 1.0, abs=0.004)  # one step of what is no straight line
    assert fit.radial == fit.sigma_radial == (0.0, 0.0)
    assert fit.sigma_focal < 0.003
    assert fit.explained > 0.05


def test_distortion_is_told_from_focal_length():
    camera = replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy)
    fit = fit_lens(adjusted(camera, radial=-0.05).left_over, num_radial=1)
    assert fit.radial[0] == pytest.approx(-0.05, abs=0.01)
    assert fit.focal == pytest.approx(0.01, abs=0.003)
    assert fit.sigma_radial[0] < 0.01


def test_the_second_coefficient_is_told_from_the_first():
    views = adjusted(CAMERA, radial=-0.1, radial_2=0.2).left_over
    fit = believed_lens(views)
    assert fit == fit_lens(views, num_radial=2)
    assert fit.radial == pytest.approx((-0.1, 0.2), abs=0.03)
    assert max(fit.sigma_radial) < 0.03
    assert abs(fit.focal) < 0.005
    # Once both are believed in they are asked for to the end, whatever they explain.
    right = adjusted(CAMERA).left_over
    assert believed_lens(right).sigma_radial == (0.0, 0.0)
    assert believed_lens(right, 2) == fit_lens(right, num_radial=2)


def test_a_lens_that_is_right_is_left_alone():
    fit = fit_lens(adjusted(CAMERA).left_over, num_radial=1)
    assert abs(fit.focal) < 4 * fit.sigma_focal < 0.012
    assert abs(fit.radial[0]) < 4 * fit.sigma_radial[0] < 0.02
    assert fit.explained < 0.01


def test_distortion_is_believed_where_it_explains_more():
    far = replace(CAMERA, fx=1.06 * CAMERA.fx, fy=1.06 * CAMERA.fy)
    straight, bent = adjusted(far).left_over, adjusted(far, radial=-0.1).left_over
    assert believed_lens(straight) == fit_lens(straight, num_radial=0)
    fit = believed_lens(bent)
    assert fit == fit_lens(bent, num_radial=1)
    # In the units of the focal length that was believed in.
    assert fit.radial[0] == pytest.approx(-0.1 / 1.06**2, abs=0.02)
    assert fit.focal == pytest.approx(0.06, abs=0.01)
    assert believed_lens(np.zeros((9, 6, 6))) is None


def test_by_hand_the_change_is_the_slope_and_its_spread_that_of_what_is_left():
    # A doubled focal length would move the points of a view by 10 in all; they are off by .012 of that.
    def view(slope):
        told = np.zeros((6, 6))
        told[RESIDUAL, RESIDUAL], told[FOCAL, FOCAL] = 4.0, 100.0
        told[RESIDUAL, FOCAL] = told[FOCAL, RESIDUAL] = 100.0 * slope
        return told

    fit = fit_lens([view(0.012)] * 4, num_radial=0)
    assert fit.focal == pytest.approx(0.012)
    assert fit.sigma_focal == pytest.approx(0.0, abs=1e-12)
    assert fit.explained == pytest.approx(0.012**2 * 100.0 / 4.0)
    # Leaving one of 1, 2, 3 out leaves means of 2.5, 2, 1.5: the jackknife has the error of the mean.
    fit = fit_lens([view(0.01), view(0.02), view(0.03)], num_radial=0)
    assert fit.sigma_focal == pytest.approx(0.01 / np.sqrt(3))
    assert spread(np.array([2.5, 2.0, 1.5])) == pytest.approx(1 / np.sqrt(3))


def test_views_that_say_nothing_are_no_lens():
    assert fit_lens(np.zeros((0, 6, 6)), num_radial=1) is None
    assert fit_lens(np.zeros((9, 6, 6)), num_radial=1) is None
    flat = np.zeros((4, 6, 6))
    flat[:, RESIDUAL, RESIDUAL] = 1.0
    assert fit_lens(flat, num_radial=0) is None
    assert grouped(flat).shape == (4, 6, 6)
