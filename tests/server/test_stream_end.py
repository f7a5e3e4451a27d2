from types import SimpleNamespace

import pytest

from semcast.common.keys import status_key
from semcast.common.metrics import Metrics
from semcast.common.wire import pack
from semcast.server.stream_end import StreamEnd


class Network:
    """Gives what an agent says of itself to who listens."""

    def subscribe(self, key, service, handle):
        assert key == status_key("a", "agent")
        self.say = handle


@pytest.fixture
def network():
    return Network()


def ended(epoch, num_sent):
    metrics = Metrics("agent")
    for _ in range(num_sent):
        metrics.count("sent")
    metrics.end()
    return pack(metrics.status(epoch))


def frame(frame_id, final=False):
    return SimpleNamespace(frame_id=frame_id, final=final)


#: Of a source of a hundred frames, every one sent.
CAMERA = SimpleNamespace(num_frames=100, last_frame_id=99, frame_step=1)


def has_come(end, idle_s, epoch=7, there=False, busy=False):
    return end.has_come(epoch, idle_s, agent_is_there=there, is_busy=busy)


def test_a_stream_of_which_nothing_came_ends_when_its_agent_has_said_so(network):
    end = StreamEnd(network, "a")
    network.say(pack(Metrics("agent").status(7)))
    network.say(b"garbage")
    assert not has_come(end, 1000.0), "an agent that is gone may come back"
    network.say(ended(6, 3))
    assert not has_come(end, 1000.0), "that was an earlier start"
    network.say(ended(7, 80))
    assert not has_come(end, 1.0), "frames may be on their way"
    assert not has_come(end, 3.0, busy=True)
    assert not end.complete
    assert has_come(end, 3.0)
    assert end.complete
    assert end.num_sent(7) == 80
    end.begin()
    assert not end.complete


def test_after_the_last_frame_an_agent_of_the_same_name_that_is_still_there_gets_its_turn(network):
    end = StreamEnd(network, "a")
    end.complete = True
    assert has_come(end, 0.6)
    assert not has_come(end, 3.5, there=True)
    assert has_come(end, 4.5, there=True)


def test_of_an_agent_that_is_gone_the_last_frames_may_be_lost_and_no_earlier_ones(network):
    end = StreamEnd(network, "a")
    end.note(frame(20), CAMERA)
    assert end.has_begun
    assert not has_come(end, 1000.0), "it may come back"
    end.note(frame(98), CAMERA)
    assert not has_come(end, 3.0, there=True)
    assert not has_come(end, 3.0, busy=True)
    assert not has_come(end, 1.9)
    assert has_come(end, 2.1)
    end.begin()
    assert not end.has_begun
    assert not has_come(end, 1000.0)


def test_the_frame_that_says_it_is_the_last_ends_the_stream(network):
    end = StreamEnd(network, "a")
    end.note(frame(20, final=True), CAMERA)
    assert not has_come(end, 0.4), "stragglers"
    assert has_come(end, 0.6)


def test_of_many_starts_the_latest_to_end_are_remembered(network):
    end = StreamEnd(network, "a")
    clock_set_back = 2
    for epoch in (3, *range(100, 115), 114, clock_set_back):
        network.say(ended(epoch, epoch + 1))
    assert [end.num_sent(epoch) for epoch in (3, 100, 114, clock_set_back)] == [None, 101, 115, 3]
