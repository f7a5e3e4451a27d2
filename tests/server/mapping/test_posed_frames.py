import numpy as np
import pytest

from semcast.common.geometry import make_transform
from semcast.server.mapping.posed_frames import PosedFrames


def pose(k):
    return make_transform(np.eye(3), (k, 2.0 * k, 1.0))


@pytest.fixture
def many():
    """More frames than there is room for at first, the newest first."""
    frames = PosedFrames()
    for k in range(999, -1, -1):
        frames[k] = (k - k % 10, pose(k))
    return frames


def test_frames_are_found_whatever_their_order(many):
    assert len(many) == 1000
    assert set(many) == set(range(1000))
    assert 999 in many
    assert 1000 not in many
    for k in (0, 255, 256, 999):
        keyframe_id, T = many[k]
        assert keyframe_id == k - k % 10
        np.testing.assert_array_equal(T, pose(k))
    with pytest.raises(KeyError):
        many[1000]


def test_a_frame_that_is_set_again_moves(many):
    many[7] = (3, pose(50))
    assert len(many) == 1000
    assert many[7][0] == 3
    np.testing.assert_array_equal(many[7][1], pose(50))


def test_a_pose_that_was_read_is_not_the_table_s(many):
    many[7][1][:] = 0.0
    np.testing.assert_array_equal(many[7][1], pose(7))


def test_columns_ascend_and_bring_the_table_back(many):
    ids, keyframe_ids, T = many.columns()
    assert ids.tolist() == list(range(1000))
    assert keyframe_ids.tolist() == [k - k % 10 for k in range(1000)]
    again = PosedFrames()
    again[5000] = (0, pose(1))
    again.take(ids, keyframe_ids, T)
    again[1000] = (990, pose(1000))
    assert len(again) == 1001
    assert 5000 not in again
    np.testing.assert_array_equal(again[256][1], pose(256))
    np.testing.assert_array_equal(again[1000][1], pose(1000))
    T[:] = 0.0
    np.testing.assert_array_equal(again[256][1], pose(256))


def test_columns_that_contradict_each_other_are_refused(many):
    ids, keyframe_ids, T = many.columns()
    with pytest.raises(ValueError, match="columns of 1000 frames must be as long, got 999 and 1000"):
        PosedFrames().take(ids, keyframe_ids[1:], T)
    with pytest.raises(ValueError, match="columns of 1000 frames must be as long, got 1000 and 999"):
        PosedFrames().take(ids, keyframe_ids, T[1:])
    with pytest.raises(ValueError, match="ids of frames must differ, got 2 twice"):
        PosedFrames().take(np.maximum(ids, 2), keyframe_ids, T)


def test_frames_of_some_keyframes_are_scaled(many):
    many.rescale({10: 2.0, 30: 0.5, 12345: 9.0})
    for k, factor in ((9, 1.0), (10, 2.0), (19, 2.0), (25, 1.0), (30, 0.5), (999, 1.0)):
        np.testing.assert_array_equal(many[k][1][:3, 3], factor * pose(k)[:3, 3])
        np.testing.assert_array_equal(many[k][1][:3, :3], np.eye(3))
    PosedFrames().rescale({1: 2.0})


def test_frames_can_be_forgotten_and_set_again():
    frames = PosedFrames()
    for k in range(5):
        frames[k] = (0, make_transform(np.eye(3), (k, 0, 0)))
    frames.forget([1, 3, 77])
    assert list(frames.columns()[0]) == [0, 2, 4]
    assert 1 not in frames
    assert frames[4][1][0, 3] == 4.0
    frames[3] = (2, np.eye(4))
    assert list(frames.columns()[1]) == [0, 0, 2, 0]
