"""Matches that move like their neighbours are told from those that don't."""

import numpy as np

from semcast.evaluation.statistics import auroc
from semcast.server.geometry.agreement import neighbour_agreement


def turned_and_zoomed(xy, degrees, factor, shift):
    a = np.radians(degrees)
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return factor * (xy - [320.0, 240.0]) @ R.T + [320.0, 240.0] + shift


def test_right_matches_are_told_from_wrong_ones_without_a_model_of_the_motion():
    rng = np.random.default_rng(0)
    xy0 = rng.uniform([0, 0], [640, 480], (300, 2))
    xy1 = turned_and_zoomed(xy0, 12.0, 1.15, [30.0, -12.0]) + 2.0 * rng.standard_normal((300, 2))
    is_wrong = rng.random(300) < 0.6
    xy1[is_wrong] = rng.uniform([0, 0], [640, 480], (int(is_wrong.sum()), 2))
    agreement = neighbour_agreement(xy0, xy1)
    assert agreement.min() >= 0.0
    assert agreement.max() <= 1.0
    assert auroc(agreement, ~is_wrong) > 0.95
    assert agreement[is_wrong].mean() < 0.1


def test_hand_computed():
    xy0 = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 0.0]])
    moves = np.array([[5.0, 0.0], [5.0, 0.0], [5.0, 0.0], [90.0, 0.0]])
    np.testing.assert_allclose(neighbour_agreement(xy0, xy0 + moves), [2 / 3, 2 / 3, 2 / 3, 0.0])


def test_a_few_matches_and_matches_at_one_place():
    assert neighbour_agreement(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0,)
    np.testing.assert_array_equal(neighbour_agreement(np.zeros((1, 2)), np.ones((1, 2))), [1.0])
    np.testing.assert_array_equal(neighbour_agreement(np.zeros((20, 2)), np.ones((20, 2))), np.ones(20))
