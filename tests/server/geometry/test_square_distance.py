import numpy as np

from semcast.server.geometry.square_distance import square_distances


def test_distances_of_all_to_all_by_hand():
    found = square_distances(
        np.array([[0.0, 0.0], [3.0, -1.0]]), np.array([[3.0, 4.0], [3.0, 0.0], [-1.0, 2.0]])
    )
    np.testing.assert_array_equal(found, [[25.0, 9.0, 5.0], [25.0, 1.0, 25.0]])


def test_sets_of_no_points_have_no_distances():
    assert square_distances(np.zeros((0, 2)), np.zeros((3, 2))).shape == (0, 3)
    assert square_distances(np.zeros((3, 2)), np.zeros((0, 2))).shape == (3, 0)
