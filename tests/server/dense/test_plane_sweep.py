"""Windows are alike at their true depth, whatever the brightness, and where they can be compared."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.geometry import exp_so3, make_transform
from semcast.server.dense.plane_sweep import UNKNOWN_COST, Neighbour, match_cost

INVERSE_DEPTHS = np.array([0.15, 0.2, 0.25, 0.3, 0.4])
MIDDLE = np.s_[10:-10, 30:-30]


@pytest.fixture(scope="module")
def pair(stand, wall):
    return stand([wall], (0.0, 0.3))


def test_the_true_depth_costs_least(pair) -> None:
    cost = match_cost(pair.views[0], [[pair.neighbour(1, 0)]], INVERSE_DEPTHS)
    assert cost.shape == (5, 120, 160)
    inner = cost[(slice(None), *MIDDLE)]
    assert (inner.argmin(axis=0) == 2).mean() > 0.95
    assert np.median(inner[2]) < 15
    assert min(np.median(inner[k]) for k in (0, 4)) > 60


def test_other_brightness_and_contrast_make_no_difference(pair) -> None:
    view = pair.views[1]
    neighbour = Neighbour(replace(view, grey=(0.5 * view.grey + 70).astype(np.uint8)), pair.T(1, 0))
    inner = match_cost(pair.views[0], [[neighbour]], INVERSE_DEPTHS)[(slice(None), *MIDDLE)]
    assert (inner.argmin(axis=0) == 2).mean() > 0.95


def test_what_no_neighbour_sees_is_unknown(pair) -> None:
    away = Neighbour(pair.views[1], make_transform(exp_so3([0.0, 1.5, 0.0]), np.zeros(3)))
    cost = match_cost(pair.views[0], [[away]], INVERSE_DEPTHS)
    assert (cost[:, :, 80] == UNKNOWN_COST).all()


def test_a_neighbour_that_does_not_see_a_pixel_leaves_it_to_the_others(pair) -> None:
    away = Neighbour(pair.views[1], make_transform(exp_so3([0.0, 1.5, 0.0]), np.zeros(3)))
    near = pair.neighbour(1, 0)
    alone, beside = (match_cost(pair.views[0], [group], INVERSE_DEPTHS) for group in ([near], [near, away]))
    # A difference of one is rounding.
    assert np.abs(alone[:, :, 80].astype(int) - beside[:, :, 80]).max() <= 1


def test_what_is_hidden_on_one_side_is_matched_on_the_other(stand, wall, plate) -> None:
    row = stand([wall, plate], (-0.5, 0.0, 0.5))
    left, right = row.neighbour(0, 1), row.neighbour(2, 1)
    at_wall = np.array([0.2, 0.25])
    # Between where the plate ends (28 px from the middle) and where both cameras see past it.
    hidden = np.s_[50:70, 111:120]
    cost = {
        k: np.median(match_cost(row.views[1], g, at_wall)[1][hidden])
        for k, g in {"left": [[left]], "right": [[right]], "both": [[left], [right]]}.items()
    }
    assert cost["left"] > 50
    assert cost["both"] <= cost["right"] < 15


def test_images_known_to_be_noisy_are_matched_in_larger_windows(stand, wall) -> None:
    row = stand([wall], (0.0, 0.3), noise_sd=40.0)
    doubted = replace(row.views[0], noise=40.0)
    right = [
        (
            match_cost(view, [[row.neighbour(1, 0)]], INVERSE_DEPTHS)[(slice(None), *MIDDLE)].argmin(0) == 2
        ).mean()
        for view in (row.views[0], doubted)
    ]
    assert right[1] > right[0] + 0.05


def test_what_is_behind_a_neighbour_is_not_seen_by_it(pair) -> None:
    """It has a place in the image of one that has driven past it: the mirror image of its own."""
    ahead = Neighbour(pair.views[1], make_transform(np.eye(3), (0.0, 0.0, -9.0)))
    near = pair.neighbour(1, 0)
    alone, beside = (match_cost(pair.views[0], [group], INVERSE_DEPTHS) for group in ([near], [near, ahead]))
    np.testing.assert_array_equal(beside, alone)
    assert (match_cost(pair.views[0], [[ahead]], INVERSE_DEPTHS) == UNKNOWN_COST).all()
