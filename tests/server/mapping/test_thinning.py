"""A map at its limits forgets a little everywhere."""

from dataclasses import dataclass

import numpy as np

from semcast.server.mapping.thinning import evenly_thinned, gaps_among, hung_on_what_is_left, least_needed


@dataclass
class Kept:
    """A keyframe as far as thinning looks at it."""

    frame_id: int
    submap: int = 0
    first_track: int = 0

    @property
    def ids(self):
        return np.arange(self.first_track, self.first_track + 50)


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


def test_behind_a_gap_are_first_keyframes_and_those_that_follow_no_track_of_the_one_before():
    keyframes = [
        Kept(0),
        Kept(3, first_track=1000),
        Kept(6, first_track=1001),
        Kept(9, 1, 2000),
        Kept(12, 0, 1002),
    ]
    submap_of = {k.frame_id: k.submap for k in keyframes}
    assert gaps_among(keyframes, submap_of) == {0, 3, 9}
    # Between two that are left another one was: nothing says that it shared no track with them.
    del keyframes[1]
    assert gaps_among(keyframes, submap_of) == {0, 9}


def test_a_gap_is_told_where_two_keyframes_are_all_there_are():
    keyframes = [Kept(0), Kept(3, first_track=1000)]
    assert gaps_among(keyframes, {0: 0, 3: 0}) == {0, 3}


def test_a_revisit_hangs_on_the_kept_keyframe_next_in_time_in_its_own_part():
    submap_of = {0: 0, 10: 0, 48: 0, 50: 1, 90: 0}
    kept = [Kept(0), Kept(50, 1), Kept(90)]
    assert hung_on_what_is_left({90: 10}, kept, submap_of) == {90: 0}
    assert hung_on_what_is_left({48: 0}, kept, submap_of) == {90: 0}, "50 is nearer, but of another part"
    assert hung_on_what_is_left({10: 0}, kept, submap_of) == {}, "both ends are the same one now"
    assert hung_on_what_is_left({90: 50}, [Kept(0), Kept(90)], submap_of) == {}, (
        "nothing is left of that part"
    )
