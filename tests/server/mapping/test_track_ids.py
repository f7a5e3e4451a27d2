import numpy as np

from semcast.server.mapping.track_ids import rows_among, shared_rows


def test_each_id_is_found_or_is_not_there():
    others = np.array([2, 5, 9])
    assert rows_among(np.array([9, 1, 5, 10, 2]), others).tolist() == [2, -1, 1, -1, 0]
    assert rows_among(others, others[:0]).tolist() == [-1, -1, -1]
    assert len(rows_among(others[:0], others)) == 0


def test_shared_rows_lead_to_the_same_ids_in_order():
    ids0, ids1 = np.array([7, 1, 4, 8]), np.array([4, 3, 7])
    row0, row1 = shared_rows(ids0, ids1)
    assert ids0[row0].tolist() == ids1[row1].tolist() == [4, 7]
