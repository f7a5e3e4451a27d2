"""A map at its limits forgets a little everywhere."""

import numpy as np

from semcast.server.mapping.thinning import evenly_thinned, least_needed


def test_keyframes_that_are_left_are_as_far_apart_as_they_can_be():
    frame_ids = np.array([0, 40, 80, 120, 122, 124, 126, 128, 160])
    assert frame_ids[evenly_thinned(frame_ids, 5)].tolist() == [0, 40, 80, 120, 160]


def test_thinning_again_and_again_leaves_no_place_out():
    kept = np.arange(0)
    for frame_id in range(4000):
        kept = np.append(kept, frame_id)
        if len(kept) > 100:
            kept = kept[evenly_thinned(kept, 50)]
    gaps = np.diff(kept)
    assert kept[0] == 0
    assert gaps.max() <= 4 * np.median(gaps)


def test_fewer_are_never_kept_than_there_are_and_none_where_none_is_wanted():
    assert evenly_thinned(np.arange(3), 5).tolist() == [0, 1, 2]
    assert evenly_thinned(np.arange(3), 1).tolist() == [0]
    assert evenly_thinned(np.arange(3), 0).tolist() == []


def test_landmarks_that_no_keyframe_sees_go_first_the_longest_unseen_before_others():
    seen = [np.array([0, 1]), np.array([3])]
    assert least_needed(seen, np.array([5, 5, 9, 5, 7]), 100, 2).tolist() == [4, 2]


def test_of_the_keyframe_with_the_most_landmarks_those_go_that_fewest_keyframes_see():
    # 0 to 5 are of the second keyframe, of which the first one sees 4 and 5 too; 6 and 7 are of the first.
    seen = [np.array([4, 5, 6, 7]), np.arange(6)]
    going = least_needed(seen, np.zeros(8, np.int64), 100, 4)
    assert set(going.tolist()) <= {0, 1, 2, 3}


def test_landmarks_of_late_stay_as_long_as_others_can_go():
    seen = [np.array([0, 1]), np.array([2, 3, 4, 5])]
    last_seen = np.array([1, 1, 8, 8, 8, 8])
    assert set(least_needed(seen, last_seen, 8, 2).tolist()) == {0, 1}
    assert least_needed(seen, np.array([1, 1, 9, 8, 9, 9]), 8, 3).tolist()[2] == 3, "the last seen go last"
