"""What an adjustment takes of what keyframes saw."""

import numpy as np

from semcast.server.mapping import window
from semcast.server.mapping.window import within_limit

#: Of eight landmarks so many observations each, in any order.
COUNT = np.array([2, 5, 1, 3, 5, 2, 4, 3])
IDS = np.arange(8) * 3 + 1
POINT = np.random.default_rng(0).permutation(np.repeat(np.arange(8), COUNT))


def test_all_that_is_seen_twice_is_taken_where_there_is_room():
    taken, kept, point = within_limit(IDS, POINT, -COUNT)
    assert taken.tolist() == [0, 1, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(taken[point], POINT[kept])
    assert kept.sum() == COUNT.sum() - 1


def test_beyond_the_limit_the_last_key_counts_first(monkeypatch):
    monkeypatch.setattr(window, "MAX_OBSERVATIONS", 14)
    assert within_limit(IDS, POINT, -COUNT)[0].tolist() == [1, 4, 6]
    last = ~np.isin(np.arange(8), [0, 5])
    taken, kept, _ = within_limit(IDS, POINT, -COUNT, last)
    assert taken.tolist() == [0, 1, 4, 5]
    assert kept.sum() == 14
