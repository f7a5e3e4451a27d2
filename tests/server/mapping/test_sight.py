import numpy as np

from semcast.server.mapping.sight import Sight


def sight_of(usable):
    return Sight(None, np.zeros((len(usable), 30), np.uint8), usable)


def test_an_image_shows_what_is_inside_its_border():
    sight = sight_of(np.ones(20, bool))
    xy = np.array([[4.0, 4.0], [3.9, 10.0], [25.9, 15.9], [26.0, 10.0], [10.0, 16.0], [np.nan, 10.0]])
    assert sight.shows(xy, 4).tolist() == [True, False, True, False, False, False]


def test_an_image_does_not_show_what_is_next_to_lost_rows():
    usable = np.ones(20, bool)
    usable[10] = False
    xy = np.array([[15.0, y] for y in (7.0, 8.0, 12.0, 13.0)])
    assert sight_of(usable).shows(xy, 2).tolist() == [True, False, False, True]


def test_in_an_image_of_fewer_rows_than_the_margins_all_are_near_a_lost_one():
    usable = np.ones(5, bool)
    usable[4] = False
    sight = sight_of(usable)
    assert sight.rows_near_lost(3).tolist() == [False, True, True, True, True]
    assert sight.rows_near_lost(10).tolist() == [True] * 5
