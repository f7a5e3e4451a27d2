"""Depths are confirmed by keyframes that see the same surface, and by no others."""

import numpy as np
import pytest

from semcast.common.geometry import exp_so3, make_transform
from semcast.server.dense.consistency import OtherDepth, agrees, back_project, num_agreeing

STEP = 0.002


@pytest.fixture(scope="module")
def row(stand, wall, plate):
    return stand([wall, plate], (0.0, 0.3, 0.6))


def other(row, k, T_other_ref=None):
    inverse = (1 / row.depths[k]).astype(np.float32)
    return OtherDepth(inverse, STEP, row.views[k].K, row.T(k, 0) if T_other_ref is None else T_other_ref)


def counts(row, others, factor=1.0):
    inverse = (1 / (factor * row.depths[0])).astype(np.float32)
    return num_agreeing(inverse, STEP, row.views[0].K, others)


def test_points_lie_where_the_depth_says(row) -> None:
    points = back_project((1 / row.depths[0]).astype(np.float32), row.views[0].K)
    assert points[60, 80] == pytest.approx([0.5 / 140 * 2, 0.5 / 140 * 2, 2.0], rel=1e-5)


def test_others_confirm_what_they_see_and_not_what_is_hidden_from_them(row) -> None:
    count = counts(row, [other(row, 1), other(row, 2)])
    assert (count[40:80, 60:100] == 2).all()  # the plate
    assert (count[:, :9] == 0).all()  # out of their sight
    # The wall just left of the plate is behind it for cameras further right.
    assert (count[45:75, 43:51] == 0).all()


def test_depths_off_by_a_twentieth_are_not_confirmed(row) -> None:
    assert (counts(row, [other(row, 1), other(row, 2)], factor=1.05)[40:80, 60:100] == 0).all()


def test_wrong_poses_confirm_little(row) -> None:
    wrong = make_transform(exp_so3([0.0, 0.05, 0.0]), (-0.3, 0.0, 0.4))
    right = counts(row, [other(row, 1)])
    assert counts(row, [other(row, 1, wrong)]).sum() < 0.1 * right.sum()


def test_unknown_depths_and_points_behind_a_camera_are_not_confirmed(row) -> None:
    inverse = np.full(row.depths[0].shape, np.nan, np.float32)
    assert not num_agreeing(inverse, STEP, row.views[0].K, [other(row, 1)]).any()
    behind = np.array([[0.0, 0.0, -4.0], [0.0, 0.0, 0.0]])
    assert not agrees(behind, STEP, other(row, 1)).any()
