"""Frames move with the keyframe they hang on, and only segments that changed are drawn again."""

import numpy as np

from semcast.common.geometry import exp_so3, make_transform
from semcast.server.view import path_table
from semcast.server.view.path_table import SEGMENT_POSES, PathTable


def at(x, y=0.0):
    return make_transform(np.eye(3), (float(x), float(y), 0.0))


def path(ids, gaps=()):
    table = PathTable()
    for k in ids:
        table.insert(k, 1000 * k, at(k), is_after_gap=k in gaps)
    return table


def lines(table, segment=0):
    return [strip[:, 0].tolist() for strip in table.strips(segment)]


def test_frames_are_in_the_order_of_their_ids_whenever_they_come():
    table = path([0, 4, 2, 4])
    assert (len(table), table.frame_ids.tolist(), table.times_ns.tolist()) == (3, [0, 2, 4], [0, 2000, 4000])
    np.testing.assert_array_equal(table.poses(1), [at(2), at(4)])
    assert lines(table) == [[0.0, 2.0, 4.0]]


def test_a_path_is_interrupted_where_the_camera_was_lost_and_not_where_a_frame_is_posed_later():
    table = path([0, 1, 5, 6], gaps=[5])
    table.insert(3, 3000, at(3), is_after_gap=True)
    assert lines(table) == [[0.0, 1.0, 3.0], [5.0, 6.0]]
    table.withdraw([5, 99])
    assert lines(table) == [[0.0, 1.0, 3.0]], "the gap is before frame 6 now, which stands alone"
    table.insert(7, 7000, at(7), is_after_gap=False)
    assert lines(table) == [[0.0, 1.0, 3.0], [6.0, 7.0]]
    table.withdraw([7])
    assert table.frame_ids.tolist() == [0, 1, 3, 6]
    table.withdraw(range(7))
    assert table.poses().shape == (0, 4, 4)


def test_the_older_half_of_an_endless_path_is_thinned_evenly_and_keeps_its_gaps(monkeypatch):
    monkeypatch.setattr(path_table, "MAX_POSES", 64)
    table = path(range(65), gaps=[11])
    assert table.frame_ids.tolist() == [*range(0, 16, 2), *range(16, 65)]
    assert [x[0] for x in lines(table)] == [0.0, 12.0], "the gap before frame 11 is before the next one now"
    for k in range(65, 1000):
        table.insert(k, 1000 * k, at(k), is_after_gap=False)
        assert len(table) <= 64
    assert table.frame_ids[0] == 0
    steps = np.diff(table.frame_ids)
    assert steps.max() <= 100, "a few times the mean: no part of the path is lost"
    assert (steps[-32:] == 1).all()
    np.testing.assert_array_equal(table.poses()[:, 0, 3], table.frame_ids)
    shown = [strip for k in range(len(table.segment_versions)) for strip in table.strips(k)]
    assert sum(len(strip) - 1 for strip in shown) == len(table) - 2


def test_frames_turn_with_their_keyframe_and_those_of_a_start_with_the_next_one():
    table = PathTable()
    table.set_keyframes({2: at(2), 5: at(5)})
    for k in (0, 3, 6):
        table.insert(k, 0, at(k), is_after_gap=False)
    quarter = make_transform(exp_so3(np.array([0.0, 0.0, np.pi / 2])), (2.0, 0.0, 0.0))
    table.set_keyframes({2: quarter})
    np.testing.assert_allclose(table.poses()[:, :3, 3], [(2, -2, 0), (3, 0, 0), (6, 0, 0)], atol=1e-12)
    table.move({3: at(3, 1), 77: at(0)})
    table.set_keyframes({5: at(5, 2)})
    np.testing.assert_allclose(table.poses()[1:, :3, 3], [(3, 3, 0), (6, 2, 0)], atol=1e-12)


def test_only_segments_that_changed_have_another_version():
    table = PathTable()
    table.set_keyframes({0: at(0)})
    for k in range(2 * SEGMENT_POSES):
        if k == SEGMENT_POSES:
            table.set_keyframes({k: at(k)})
        table.insert(k, 0, at(k), is_after_gap=False)
    before = list(table.segment_versions)
    table.set_keyframes({0: at(0), SEGMENT_POSES: at(SEGMENT_POSES, 1)})
    changed = [now != then for now, then in zip(table.segment_versions, before, strict=True)]
    assert changed == [False, True]
    assert lines(table, 1)[0][:2] == [SEGMENT_POSES - 1.0, SEGMENT_POSES], "it joins the one before"
    before = list(table.segment_versions)
    table.set_keyframes({0: at(0, 3)})
    changed = [now != then for now, then in zip(table.segment_versions, before, strict=True)]
    assert changed == [True, True], "the second begins with the last pose of the first, which has moved"
    before = list(table.segment_versions)
    table.set_keyframes({SEGMENT_POSES: at(SEGMENT_POSES, 2)})
    assert len(table.segment_versions) == len(before), "there is no segment after the last pose"
    before = list(table.segment_versions)
    table.move({})
    table.withdraw([99 * SEGMENT_POSES])
    assert table.segment_versions == before


def test_where_the_camera_was_last_is_a_keyframe_before_there_is_a_frame():
    table = PathTable()
    assert table.newest_centre is None
    table.set_keyframes({3: at(3), 1: at(1)})
    assert table.newest_centre.tolist() == [3.0, 0.0, 0.0]
    table.insert(5, 0, at(4), is_after_gap=False)
    assert table.newest_centre.tolist() == [4.0, 0.0, 0.0]
