"""Frames that were sent are told from those that were not."""

import pytest

from semcast.server.sent_frames import Stretch, stretches, unposed_ranges


def sent_ids(numbers, **how):
    return [int(k) for stretch in stretches(numbers, **how) for k in stretch.frame_ids]


def test_frames_without_a_number_were_not_sent():
    # One in two, then one in three; number 3 never arrived.
    assert sent_ids({0: 0, 2: 1, 4: 2, 8: 4, 11: 5, 14: 6}) == [0, 2, 4, 6, 8, 11, 14]
    assert sent_ids({}) == []
    assert sent_ids({7: 3}) == [7]


def test_frames_before_the_first_that_arrived_count_on_request():
    assert sent_ids({6: 3, 8: 4}, from_first=True) == [0, 2, 4, 6, 8]
    assert sent_ids({6: 3, 8: 4}) == [6, 8]
    assert sent_ids({0: 0, 1: 1}, from_first=True) == [0, 1]
    assert sent_ids({}, from_first=True) == []


def test_where_a_number_is_unknown_the_common_stride_counts():
    assert sent_ids({0: None, 2: None, 8: None}) == [0, 2, 4, 6, 8]
    assert sent_ids({10: None, 12: 1, 18: 2}, from_first=True) == [10, 12, 14, 16, 18]


@pytest.mark.parametrize("numbers", [{0: 0, 3: 2**62}, {0: 5, 3: 2}, {0: 0, 2**62: 2**62}])
def test_absurd_numbers_cost_nothing_and_imply_no_more_frames_than_there_are_ids(numbers):
    first, *between, last = stretches(numbers)
    assert (first, last) == (Stretch(0, 0, 1), Stretch(max(numbers), max(numbers), 1))
    assert sum(stretch.num for stretch in between) <= max(numbers) - 1


def test_unposed_ranges_by_hand():
    sent = stretches({k: k for k in (0, 1, 2, 3, 5, 6, 9)})
    assert unposed_ranges(sent, {2, 6}) == [(0, 1), (3, 5), (7, 9)]
    assert unposed_ranges(sent, {0, 1, 2, 3, 5, 6, 9}) == [(4, 4), (7, 8)]
    assert unposed_ranges(stretches({0: 0, 1: 1}), {0, 1}) == []
    assert unposed_ranges([], set()) == []


def test_what_was_sent_behind_the_last_that_arrived_counts_where_it_is_known():
    numbers = {0: 0, 3: 1, 6: 2}
    assert stretches(numbers, num_sent=3) == stretches(numbers)
    assert stretches(numbers, num_sent=5)[-1] == Stretch(9, 12, 2)
    assert stretches({12: 4, 18: 6}, num_sent=9)[-1] == Stretch(21, 24, 2)
    assert stretches({}, num_sent=4) == [Stretch(0, 3, 4)]
    assert stretches({5: 2}, num_sent=4)[-1] == Stretch(6, 6, 1)
    assert stretches({0: None, 1: None}, num_sent=9) == stretches({0: None, 1: None})
