import threading

from semcast.common import status_beat
from semcast.common.metrics import Metrics
from semcast.common.status_beat import StatusBeat


class Session:
    """Keeps what is published."""

    def __init__(self):
        self.came = threading.Event()
        self.num_sent = 0

    def publisher(self, key, service):
        return self

    def put(self, payload):
        self.num_sent += 1
        self.came.set()


def test_a_status_that_can_not_be_made_is_not_the_last_one(monkeypatch):
    monkeypatch.setattr(status_beat, "STATUS_INTERVAL_S", 0.01)
    session, metrics, asked = Session(), Metrics("server"), []

    def epoch():
        asked.append(1)
        if len(asked) == 1:
            raise RuntimeError("no epoch")
        return 7

    beat = StatusBeat(session, "cam0", "server", metrics, epoch)
    assert session.came.wait(10)
    beat.close()
    beat.close()
    assert session.num_sent >= 2, "one in between and one at the end"
    assert metrics.status(7).last_error == "sending the status failed: no epoch"
