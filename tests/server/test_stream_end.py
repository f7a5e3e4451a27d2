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
    metrics.count("sent", num_sent)
    metrics.end()
    return pack(metrics.status(epoch))


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
