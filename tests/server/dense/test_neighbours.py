"""Which other views the depth of a keyframe is estimated from, and between which depths."""

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, make_transform
from semcast.server.dense.neighbours import (
    DepthRange,
    choose_neighbours,
    confirming,
    depth_problem,
    depth_range,
    num_to_confirm,
)


def test_depth_is_sought_around_that_of_landmarks_but_for_the_outermost():
    assert depth_range(np.arange(1.0, 102.0)) == pytest.approx((3.0 / 1.3, 51.0, 99.0 * 1.5))
    assert depth_range(np.ones(10)) == pytest.approx((1 / 1.3, 1.0, 1.5))
    assert depth_range(np.ones(9)) is None


def chosen(*views):
    """Numbers of those of some poses that are chosen at a depth of 10."""
    return [n.view for n in choose_neighbours(np.eye(4), 10.0, enumerate(views))]


def along(x):
    return make_transform(np.eye(3), (x, 0.0, 0.0))


def turned(deg):
    return along(2.0) @ exp_se3([0.0, np.radians(deg), 0.0, 0.0, 0.0, 0.0])


def test_each_neighbour_is_a_step_further_away_than_the_one_before():
    assert chosen(along(0.39), along(0.41), along(0.79), along(0.81), along(5.0)) == [1, 3], "two are enough"


def test_behind_a_view_that_looks_elsewhere_none_is_sought():
    assert chosen(turned(39.0), along(3.0)) == [0, 1]
    assert chosen(turned(41.0), along(3.0)) == []


def test_a_problem_has_the_neighbours_of_each_side_that_has_some():
    sought = DepthRange(2.0, 10.0, 40.0)
    both = depth_problem("view", np.eye(4), sought, [[(1, along(-0.5))], [(2, along(0.5)), (3, along(1.0))]])
    assert [[n.view for n in group] for group in both.groups] == [[1], [2, 3]]
    assert (both.reference, both.nearest, both.farthest) == ("view", 2.0, 40.0)
    one = depth_problem("view", np.eye(4), sought, [[(1, along(-0.1))], [(2, along(0.5))]])
    assert [[n.view for n in group] for group in one.groups] == [[2]]
    assert depth_problem("view", np.eye(4), sought, [[(1, along(-0.1))], []]) is None


def test_three_keyframes_on_either_side_may_confirm_one():
    assert confirming({1, 9, 2, 3, 4, 5, 6, 7, 8}, 5) == [2, 3, 4, 6, 7, 8]
    assert confirming([1, 2, 8], 2) == [1, 8]
    assert confirming([2], 2) == []


def test_one_other_depth_confirms_where_there_are_at_most_two():
    assert [num_to_confirm(num) for num in (1, 2, 3, 6)] == [1, 1, 2, 2]
