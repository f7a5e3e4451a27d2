"""Depths are confirmed by keyframes that see the same surface, and by no others."""

import numpy as np
import pytest

from semcast.common.geometry import exp_so3, make_transform
from semcast.server.dense.consistency import (
    OtherDepth,
    added_points,
    back_project,
    confirmed_by,
    confirmed_depth,
    not_yet_seen,
)
from semcast.server.dense.depth_map import DepthMap

STEP = 0.002


@pytest.fixture(scope="module")
def row(stand, wall, plate):
    return stand([wall, plate], (0.0, 0.3, 0.6))


def other(row, k, T_other_ref=None):
    inverse = (1 / row.depths[k]).astype(np.float32)
    return OtherDepth(inverse, STEP, row.views[k].K, row.T(k, 0) if T_other_ref is None else T_other_ref)


def confirmed(row, others, num_needed=1, factor=1.0):
    inverse = (1 / (factor * row.depths[0])).astype(np.float32)
    return confirmed_depth(inverse, STEP, row.views[0].K, others, num_needed)


def test_points_lie_where_the_depth_says(row) -> None:
    points = back_project((1 / row.depths[0]).astype(np.float32), row.views[0].K)
    assert points[60, 80] == pytest.approx([0.5 / 140 * 2, 0.5 / 140 * 2, 2.0], rel=1e-5)


def test_others_confirm_what_they_see_and_not_what_is_hidden_from_them(row) -> None:
    found = confirmed(row, [other(row, 1), other(row, 2)], num_needed=2)
    np.testing.assert_allclose(found[40:80, 60:100], 0.5, rtol=1e-6)  # the plate
    by_one = np.isfinite(confirmed(row, [other(row, 1), other(row, 2)]))
    assert not by_one[:, :9].any()  # out of their sight
    # The wall just left of the plate is behind it for cameras further right.
    assert not by_one[45:75, 43:51].any()


def test_depths_off_by_a_twentieth_are_not_confirmed(row) -> None:
    found = confirmed(row, [other(row, 1), other(row, 2)], factor=1.05)
    assert np.isnan(found[40:80, 60:100]).all()


def test_wrong_poses_confirm_little(row) -> None:
    wrong = make_transform(exp_so3([0.0, 0.05, 0.0]), (-0.3, 0.0, 0.4))
    right, little = (np.isfinite(confirmed(row, [other(row, 1, T)])).sum() for T in (None, wrong))
    assert little < 0.1 * right


def test_a_confirmed_depth_is_the_mean_of_those_that_agree_by_their_steps(row) -> None:
    """Of another camera ahead of the first one, what is nearer to it by a share is so along the ray too."""
    inverse = np.full((120, 160), 1 / 4.0, np.float32)
    ahead = make_transform(np.eye(3), (0.0, 0.0, -1.0))
    exact = OtherDepth(np.full((120, 160), 1.01 / 3.0, np.float32), 0.5 * STEP, row.views[0].K, ahead)
    elsewhere = OtherDepth(np.full((120, 160), 1.5 / 3.0, np.float32), STEP, row.views[0].K, ahead)
    found = confirmed_depth(inverse, STEP, row.views[0].K, [exact, elsewhere], 1)
    np.testing.assert_allclose(found[30:90, 40:120], 0.25 * (1 + 0.01 * 4 / 5), rtol=1e-5)
    assert np.isnan(confirmed_depth(inverse, STEP, row.views[0].K, [exact, elsewhere], 2)).all()


def test_noise_of_depths_that_agree_averages_out(row) -> None:
    rng = np.random.default_rng(5)

    def noisy(k):
        return (1 / row.depths[k] + rng.normal(0.0, 0.5 * STEP, row.depths[k].shape)).astype(np.float32)

    others = [OtherDepth(noisy(k), STEP, row.views[k].K, row.T(k, 0)) for k in (1, 2)]
    own = noisy(0)
    found = confirmed_depth(own, STEP, row.views[0].K, others, 2)
    sure = np.isfinite(found)
    before, after = (np.std((depth - 1 / row.depths[0])[sure]) for depth in (own, found))
    assert sure.mean() > 0.5
    assert after < 0.65 * before  # one over the root of three is 0.58


def test_unknown_depths_and_points_behind_a_camera_are_not_confirmed(row) -> None:
    inverse = np.full(row.depths[0].shape, np.nan, np.float32)
    assert np.isnan(confirmed_depth(inverse, STEP, row.views[0].K, [other(row, 1)], 1)).all()
    behind = np.array([[0.0, 0.0, -4.0], [0.0, 0.0, 0.0]])
    assert not_yet_seen(behind, STEP, [other(row, 1)]).all()


def test_what_another_keyframe_saw_is_not_new(row) -> None:
    points = back_project((1 / row.depths[0]).astype(np.float32), row.views[0].K)
    new = not_yet_seen(points.reshape(-1, 3), STEP, [other(row, 1), other(row, 2)]).reshape(120, 160)
    assert not new[40:80, 60:100].any()
    assert new[:, :9].all()
    assert not_yet_seen(points.reshape(-1, 3), STEP, []).all()


def test_of_three_others_two_have_to_confirm_a_map(row) -> None:
    found = DepthMap(7, (1 / row.depths[0]).astype(np.float32), STEP)
    away = make_transform(np.eye(3), (0.0, 0.0, -90.0))  # sees nothing of it where it is
    one_of_three = [other(row, 1), other(row, 1, away), other(row, 1, away)]
    assert np.isnan(confirmed_by(found, row.views[0].K, one_of_three).inverse_depth).all()
    one_of_two = confirmed_by(found, row.views[0].K, one_of_three[:2])
    assert (one_of_two.frame_id, one_of_two.step) == (7, STEP)
    np.testing.assert_array_equal(one_of_two.inverse_depth, confirmed(row, one_of_three[:1]))


def test_what_is_added_to_the_cloud_is_sure_and_new(row) -> None:
    inverse = (1 / row.depths[0]).astype(np.float32)
    inverse[:60] = np.nan
    points, pixels = added_points(DepthMap(7, inverse, STEP), row.views[0].K, [other(row, 1)])
    assert not pixels[:60].any()
    assert not pixels[65:75, 65:95].any(), "the other one has the plate"
    assert pixels[60:, :9].all(), "and not what is out of its sight"
    np.testing.assert_array_equal(points, back_project(inverse, row.views[0].K)[pixels])
