import pytest

from semcast.agent.replay_window import ReplayWindow
from semcast.common.messages import FlowMessage, SymbolFrame

EPOCH = 7


class Clock:
    def __init__(self):
        self.now_s = 50.0

    def __call__(self):
        return self.now_s


def frame(seq):
    return SymbolFrame(
        agent_epoch=EPOCH, seq=seq, frame_id=seq, t_capture_ns=0, t_source_ns=0, codec="x", digest="",
        image_hw=(16, 16), modulation="16qam", num_slots=1, uses_per_slot=48, direction="tx",
        payload_format="qam16", payload=bytes(24), lossless=True,
    )  # fmt: skip


def flow(next_seq, arrived_seq=None, epoch=EPOCH, window=3):
    arrived_seq = next_seq if arrived_seq is None else arrived_seq
    return FlowMessage(agent_epoch=epoch, next_seq=next_seq, arrived_seq=arrived_seq, window=window)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def window(clock):
    return ReplayWindow(EPOCH, clock, resend_after_s=1.0)


def fill(window, start):
    while window.has_room:
        window.add(frame(start))
        start += 1
    return start


def seqs(frames):
    return [f.seq for f in frames]


def test_nothing_is_sent_before_a_receiver_is_there(window):
    assert not window.has_room
    window.on_flow(flow(0, epoch=0))
    assert fill(window, 0) == 3
    assert seqs(window.due()) == [0, 1, 2]
    assert window.due() == [], "each is sent once"


def test_room_opens_as_the_consumer_takes_frames(window):
    window.on_flow(flow(0, epoch=0))
    fill(window, 0)
    window.due()
    window.on_flow(flow(1, arrived_seq=3))
    assert fill(window, 3) == 4
    due = window.due()
    assert seqs(due) == [3]
    assert due[0].base_seq == 1
    window.on_flow(flow(4))
    assert window.all_taken


def test_what_arrives_begins_the_patience_anew(window, clock):
    window.on_flow(flow(0, epoch=0))
    fill(window, 0)
    window.due()
    clock.now_s += 1.0
    assert seqs(window.due()) == [0, 1, 2], "in vain, so the next time is 2 s later"
    clock.now_s += 1.5
    window.on_flow(flow(0, arrived_seq=1))
    clock.now_s += 0.9
    assert window.due() == [], "something arrived 0.9 s ago"
    clock.now_s += 0.1
    assert seqs(window.due()) == [1, 2]


def test_what_does_not_arrive_is_sent_again_with_growing_patience(window, clock):
    window.on_flow(flow(0, epoch=0))
    fill(window, 0)
    window.due()
    window.on_flow(flow(0, arrived_seq=1))
    clock.now_s += 0.9
    assert window.due() == []
    clock.now_s += 0.2
    assert seqs(window.due()) == [1, 2], "0 has arrived"
    clock.now_s += 1.1
    assert window.due() == []
    clock.now_s += 1.0
    assert seqs(window.due()) == [1, 2]
    window.on_flow(flow(0, arrived_seq=3))
    clock.now_s += 100.0
    assert window.due() == [], "all have arrived, they only wait to be taken"


def test_a_new_receiver_gets_what_the_old_one_had_not_taken(window):
    window.on_flow(flow(0, epoch=0))
    fill(window, 0)
    window.due()
    window.on_flow(flow(1, arrived_seq=3))
    window.on_flow(flow(0, epoch=0))
    due = window.due()
    assert seqs(due) == [1, 2]
    assert {f.base_seq for f in due} == {1}
    window.on_flow(flow(0, epoch=0))
    assert window.due() == [], "its repeated greeting does not make frames be sent over and over"


def test_flow_of_another_agent_or_beyond_what_was_sent_confirms_nothing(window):
    window.on_flow(flow(0, epoch=0))
    fill(window, 0)
    window.due()
    window.on_flow(flow(2, epoch=EPOCH - 1))
    assert not window.all_taken
    window.on_flow(flow(10**9))
    assert window.all_taken
    assert fill(window, 3) == 6


def test_frames_must_come_in_order(window):
    with pytest.raises(ValueError, match="seq must be 0, got 1"):
        window.add(frame(1))
