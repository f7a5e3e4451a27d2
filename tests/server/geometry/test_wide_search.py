"""Tracks found again after a jump."""

import numpy as np

from semcast.server.geometry.wide_search import (
    WideFeatures,
    clear_matches,
    epipolar_inliers,
    expected_matches,
    search_wide,
)


def drifted(seed, count=30, num_wrong=2):
    """Matches of an image that moved by a pixel and a half, the first ones wrong."""
    rng = np.random.default_rng(seed)
    from_xy = rng.integers(0, 320, (count, 2)).astype(float)
    to_xy = from_xy + (-1.5, -0.5) + 0.2 * rng.standard_normal((count, 2))
    to_xy[:num_wrong] = rng.uniform(0, 300, (num_wrong, 2))
    return from_xy, to_xy


def test_matches_of_images_that_hardly_moved_are_no_error():
    # OpenCV 5 raises on one of six such sets.
    for seed in range(30):
        agrees = epipolar_inliers(*drifted(seed))
        assert agrees is not None
        assert agrees.shape == (30,)
        assert agrees[2:].mean() > 0.9


def test_images_without_anything_give_no_places():
    blank = WideFeatures.of(np.full((240, 320), 90, np.uint8))
    assert search_wide(blank, blank, np.zeros((0, 2))) is None
    assert search_wide(blank, blank, np.full((30, 2), 100.0)) is None


def described(descriptors, xy):
    xy = np.array(xy, float).reshape(-1, 2)
    return WideFeatures(xy, np.ones(len(xy)), np.zeros(len(xy)), np.array(descriptors, np.float32))


def unlike_each_other(count, seed=0):
    """Descriptors of the usual length."""
    drawn = np.abs(np.random.default_rng(seed).standard_normal((count, 128)))
    return 512.0 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def test_of_two_features_that_match_the_same_one_the_liker_does():
    d = unlike_each_other(3)
    first = described([0.95 * d[0], d[0], d[1]], [(0, 0), (9, 9), (50, 50)])
    second = described([d[2], d[1], d[0]], [(80, 0), (51, 50), (10, 9)])
    row0, row1 = clear_matches(first, second, 0.8)
    assert row0.tolist() == [1, 2]
    assert row1.tolist() == [2, 1]


def test_a_texture_that_repeats_matches_where_it_is_expected():
    d = unlike_each_other(2)
    first = described([d[0], d[1]], [(0, 0), (100, 100)])
    second = described([d[0], d[0], d[1]], [(0, 0), (300, 0), (200, 200)])
    assert len(clear_matches(first[:1], second, 0.8)[0]) == 0
    row0, row1 = expected_matches(first, second, np.array([[290.0, 5.0], [np.nan, 0.0]]), 20.0, 0.8)
    assert (row0.tolist(), row1.tolist()) == ([0], [1])
    nothing = expected_matches(first[:0], second, np.zeros((0, 2)), 20.0, 0.8)
    assert len(nothing[0]) == len(nothing[1]) == 0
