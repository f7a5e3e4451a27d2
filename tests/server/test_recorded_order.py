import pytest

from semcast.server.recorded_order import in_order

FAR = 2**62


@pytest.mark.parametrize(
    ("recorded", "taken"),
    [
        ([], []),
        ([3], [3]),
        ([0, 1, 2, 5, 9], [0, 1, 2, 5, 9]),
        ([0, 1, 2, 0, 1, 2, 3, 3], [0, 1, 2, 3]),  # sent again
        ([0, 2, 1, 3, 4, 5], [0, 2, 3, 4, 5]),  # late
        ([7, 5, 6, 7, 8, 9], [7, 8, 9]),
        ([FAR, 0, 1, 2, 3, 4], [0, 1, 2, 3, 4]),
        ([0, 1, FAR, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
        ([0, 1, FAR, 2, FAR + 1, 3, 4, 5, 6, 7], [0, 1, 2, 3, 4, 5, 6, 7]),
        ([0, 1, 2, FAR], [0, 1, 2, FAR]),
        ([0, 1, 1000, 1001, 1002, 1003], [0, 1, 1000, 1001, 1002, 1003]),  # after a gap
    ],
)
def test_frames_come_in_order_and_once_without_ids_that_later_ones_refute(recorded, taken):
    assert list(in_order(recorded, lambda frame_id: frame_id)) == taken


def test_a_frame_that_is_left_out_is_told(caplog):
    assert list(in_order([FAR, 0, 1, 2], int)) == [0, 1, 2]
    assert caplog.messages == [f"frame {FAR} is left out: those that follow are below it"]


def test_few_frames_are_read_ahead():
    read = []
    frames = in_order((read.append(k) or k for k in range(100)), int)
    assert [next(frames) for _ in range(10)] == list(range(10))
    assert len(read) < 20
