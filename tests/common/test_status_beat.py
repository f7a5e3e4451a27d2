import threading

from semcast.common import status_beat
from semcast.common.keys import status_key
from semcast.common.messages import StatusMessage
from semcast.common.metrics import Metrics
from semcast.common.status_beat import StatusBeat
from semcast.common.wire import unpack


class Publisher:
    """Keeps what is published."""

    def __init__(self):
        self.came = threading.Event()
        self.sent = []

    def put(self, payload):
        self.sent.append(unpack(payload, StatusMessage))
        self.came.set()


class Session:
    """Has one publisher for what a busy link may drop, and one for what it may not."""

    def __init__(self):
        self.publishers = {"newest": Publisher(), "every": Publisher()}

    def publisher(self, key, service):
        assert key == status_key("cam0", "server")
        return self.publishers[service]


def test_a_status_that_can_not_be_made_is_not_the_last_one(monkeypatch):
    monkeypatch.setattr(status_beat, "STATUS_INTERVAL_S", 0.01)
    session, metrics, asked = Session(), Metrics("server"), []

    def epoch():
        asked.append(1)
        if len(asked) == 1:
            raise RuntimeError("no epoch")
        return 7

    beat = StatusBeat(session, "cam0", "server", metrics, epoch)
    droppable, kept = session.publishers["newest"], session.publishers["every"]
    assert droppable.came.wait(10)
    assert not kept.sent, "a status of which another one comes soon never waits"
    metrics.end()
    beat.close()
    beat.close()
    assert [status.ended for status in kept.sent] == [True], "the last one, once, may not be dropped"
    assert metrics.status(7).last_error == "sending the status failed: no epoch"
