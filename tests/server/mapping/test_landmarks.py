import numpy as np

from semcast.server.mapping.landmarks import Landmarks


def add(landmarks, ids):
    ids = np.array(ids, np.int64)
    xyz = np.stack([ids, ids, ids], axis=1).astype(float)
    landmarks.add(ids, xyz, np.full((len(ids), 3), 7, np.uint8), np.ones(len(ids)), 0, 0)


def test_landmarks_stay_sorted_and_are_found_by_id():
    landmarks = Landmarks()
    assert landmarks.rows(np.array([4])).tolist() == [-1]
    add(landmarks, [5, 9])
    add(landmarks, [1, 7])
    assert landmarks.ids.tolist() == [1, 5, 7, 9]
    assert landmarks.xyz[:, 0].tolist() == [1, 5, 7, 9]
    assert landmarks.rows(np.array([9, 2, 1])).tolist() == [3, -1, 0]
    landmarks.keep(landmarks.ids > 4)
    assert landmarks.ids.tolist() == [5, 7, 9]
    assert len(landmarks.born) == len(landmarks) == 3
