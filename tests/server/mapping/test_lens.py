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
    fit = fit_lens(adjusted(camera).left_over, with_radial=False)
    assert fit.focal == pytest.approx(factor - 1.0, abs=0.004)  # one step of what is no straight line
    assert (fit.radial, fit.sigma_radial) == (0.0, 0.0)
    assert fit.sigma_focal < 0.003
    assert fit.explained > 0.05


def test_distortion_is_told_from_focal_length():
    camera = replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy)
    fit = fit_lens(adjusted(camera, radial=-0.05).left_over, with_radial=True)
    assert fit.radial == pytest.approx(-0.05, abs=0.01)
    assert fit.focal == pytest.approx(0.01, abs=0.003)
    assert fit.sigma_radial < 0.01


def test_a_lens_that_is_right_is_left_alone():
    fit = fit_lens(adjusted(CAMERA).left_over, with_radial=True)
    assert abs(fit.focal) < 4 * fit.sigma_focal < 0.012
    assert abs(fit.radial) < 4 * fit.sigma_radial < 0.02
    assert fit.explained < 0.01


def test_distortion_is_believed_where_it_explains_more():
    far = replace(CAMERA, fx=1.06 * CAMERA.fx, fy=1.06 * CAMERA.fy)
    straight, bent = adjusted(far).left_over, adjusted(far, radial=-0.1).left_over
    assert believed_lens(straight) == fit_lens(straight, with_radial=False)
    fit = believed_lens(bent)
    assert fit == fit_lens(bent, with_radial=True)
    # In the units of the focal length that was believed in.
    assert fit.radial == pytest.approx(-0.1 / 1.06**2, abs=0.02)
    assert fit.focal == pytest.approx(0.06, abs=0.01)
    assert believed_lens(np.zeros((9, 5, 5))) is None


def test_by_hand_the_change_is_the_slope_and_its_spread_that_of_what_is_left():
    # A doubled focal length would move the points of a view by 10 in all; they are off by .012 of that.
    def view(slope):
        told = np.zeros((5, 5))
        told[RESIDUAL, RESIDUAL], told[FOCAL, FOCAL] = 4.0, 100.0
        told[RESIDUAL, FOCAL] = told[FOCAL, RESIDUAL] = 100.0 * slope
        return told

    fit = fit_lens([view(0.012)] * 4, with_radial=False)
    assert fit.focal == pytest.approx(0.012)
    assert fit.sigma_focal == pytest.approx(0.0, abs=1e-12)
    assert fit.explained == pytest.approx(0.012**2 * 100.0 / 4.0)
    # Leaving one of 1, 2, 3 out leaves means of 2.5, 2, 1.5: the jackknife has the error of the mean.
    fit = fit_lens([view(0.01), view(0.02), view(0.03)], with_radial=False)
    assert fit.sigma_focal == pytest.approx(0.01 / np.sqrt(3))
    assert spread(np.array([2.5, 2.0, 1.5])) == pytest.approx(1 / np.sqrt(3))


def test_views_that_say_nothing_are_no_lens():
    assert fit_lens(np.zeros((0, 5, 5)), with_radial=True) is None
    assert fit_lens(np.zeros((9, 5, 5)), with_radial=True) is None
    flat = np.zeros((4, 5, 5))
    flat[:, RESIDUAL, RESIDUAL] = 1.0
    assert fit_lens(flat, with_radial=False) is None
    assert grouped(flat).shape == (4, 5, 5)
