"""What is published reaches who is slow: all of the map, and the newest poses."""

import threading
from types import SimpleNamespace

import numpy as np
from waiting import until

from semcast.common.map_mirror import _EMPTY
from semcast.common.messages import MapMessage
from semcast.common.metrics import Metrics
from semcast.common.wire import unpack
from semcast.server.mapping.state import MapUpdate
from semcast.server.outbox import CAPACITY, Outbox, map_message

AGENT = "cam0"
ARRIVAL = SimpleNamespace(message=SimpleNamespace(agent_epoch=5))


class SlowSession:
    """Publishers that hold the first message until they may go on."""

    def __init__(self):
        self.sent: list[bytes] = []
        self.holding, self.may_go_on = threading.Event(), threading.Event()

    def publisher(self, key, service):
        return self

    def put(self, payload):
        self.holding.set()
        assert self.may_go_on.wait(30.0)
        self.sent.append(payload)


def some_change(rng, map_epoch):
    ids = rng.choice(40, size=rng.integers(0, 6), replace=False)
    keyframe_ids = rng.choice(9, size=rng.integers(0, 3), replace=False)
    return MapUpdate(
        map_epoch=map_epoch,
        ids=ids,
        xyz=rng.normal(size=(len(ids), 3)),
        rgb=rng.integers(0, 256, (len(ids), 3), dtype=np.uint8),
        confidence=rng.random(len(ids)).astype(np.float32),
        removed=np.setdiff1d(rng.choice(40, size=3, replace=False), ids),
        keyframe_ids=keyframe_ids,
        keyframe_poses=rng.normal(size=(len(keyframe_ids), 4, 4)),
        frame_ids=np.zeros(0, np.int64),
        frame_poses=np.zeros((0, 4, 4)),
        withdrawn=np.zeros(0, np.int64),
    )


def test_a_slow_subscriber_misses_nothing_of_the_map(rng):
    for map_epochs in ((0,), (0, 1)):
        updates = [some_change(rng, e) for e in map_epochs for _ in range(CAPACITY + 50)]
        session, metrics = SlowSession(), Metrics("server")
        outbox = Outbox(session, AGENT, metrics)
        outbox.put_map(ARRIVAL.message.agent_epoch, updates[0])
        assert session.holding.wait(30.0)
        for update in updates[1:]:
            outbox.put_map(ARRIVAL.message.agent_epoch, update)
        session.may_go_on.set()
        outbox.close()
        expected = found = _EMPTY
        for update in updates:
            expected = expected.updated(map_message(5, update))
        for payload in session.sent:
            found = found.updated(unpack(payload, MapMessage))
        assert len(expected.ids) > 10
        for name in ("map_epoch", "ids", "xyz", "rgb", "confidence", "keyframe_ids", "keyframe_poses"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
        assert len(session.sent) == 2, "what waits is sent as one"
        assert not metrics.drops


def test_what_can_not_be_sent_costs_itself_alone(rng, monkeypatch):
    session, metrics = SlowSession(), Metrics("server")
    session.may_go_on.set()
    outbox = Outbox(session, AGENT, metrics)
    with monkeypatch.context() as patch:
        patch.setattr("semcast.server.outbox.pack", lambda message: 1 / 0)
        outbox.put_map(5, some_change(rng, 0))
        until(lambda: metrics.drops)
    outbox.put_map(5, some_change(rng, 0))
    outbox.close()
    assert len(session.sent) == 1
    assert metrics.drops == {"unsent": 1}
    assert metrics.status(5).last_error == "sending what was found failed: division by zero"
