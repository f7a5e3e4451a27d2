"""Originals published beside the symbols."""

import threading

import cv2
import numpy as np
import pytest

from semcast.agent.originals import OriginalSharer, source_image
from semcast.agent.source import SourceFrame
from semcast.common.errors import TransportError
from semcast.common.keys import source_key
from semcast.common.messages import SourceImage
from semcast.common.metrics import Metrics
from semcast.common.wire import unpack


def frame(frame_id, shape_hw=(48, 64)):
    ramp = np.linspace(0, 255, shape_hw[1])[None, :, None] * np.array([1.0, 0.5, 0.1])
    image = np.broadcast_to(ramp, (*shape_hw, 3)).astype(np.uint8)
    return SourceFrame(frame_id=frame_id, t_source_ns=0, t_capture_ns=0, stored=image)


@pytest.mark.parametrize(("image_format", "largest"), [("png", 0), ("jpeg", 24)])
def test_an_original_comes_back_in_its_colours(image_format, largest):
    sent = frame(7)
    message = source_image(sent, 5, image_format)
    assert (message.agent_epoch, message.frame_id, message.image_hw) == (5, 7, (48, 64))
    back = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(back.astype(int) - sent.image).max() <= largest


class SlowSession:
    """Stands for a session whose publisher takes until it is let go."""

    def __init__(self):
        self.go = threading.Event()
        self.sent = []
        self.services = []

    def publisher(self, key, service):
        assert key == source_key("agent0")
        self.services.append(service)
        return self

    def put(self, payload):
        assert self.go.wait(10)
        self.sent.append(unpack(payload, SourceImage).frame_id)


def test_live_sharing_never_waits_and_counts_what_it_leaves_out():
    session, metrics = SlowSession(), Metrics("agent")
    sharer = OriginalSharer(session, "agent0", 1, "jpeg", False, metrics, threading.Event())
    for k in range(10):
        sharer.put(frame(k))
    session.go.set()
    sharer.close()
    sharer.close()
    assert session.services == ["newest"]
    assert session.sent[-1] == 9
    assert session.sent == sorted(session.sent)
    left_out = metrics.summary()["drops"]["source_superseded"]
    assert left_out >= 7
    assert len(session.sent) + left_out == 10 == left_out + metrics.summary()["counts"]["source_shared"]


def test_lossless_sharing_leaves_out_nothing():
    session, metrics = SlowSession(), Metrics("agent")
    session.go.set()
    sharer = OriginalSharer(session, "agent0", 1, "jpeg", True, metrics, threading.Event())
    for k in range(10):
        sharer.put(frame(k))
    sharer.close()
    assert (session.services, session.sent) == (["every"], list(range(10)))


class BrokenSession(SlowSession):
    """Its publisher fails."""

    def put(self, payload):
        raise TransportError("the session is closed")


def test_a_sender_is_not_held_up_for_ever():
    session, metrics, stop = SlowSession(), Metrics("agent"), threading.Event()
    sharer = OriginalSharer(session, "agent0", 1, "jpeg", True, metrics, stop)
    threading.Timer(0.3, stop.set).start()
    for k in range(6):
        sharer.put(frame(k))  # nothing is taken: only the stop lets the later ones through
    session.go.set()
    sharer.close()
    assert session.sent[0] == 0

    broken = OriginalSharer(BrokenSession(), "agent0", 1, "jpeg", True, metrics, threading.Event())
    for k in range(6):
        broken.put(frame(k))
    broken.close()
    assert metrics.status(1).last_error == "the session is closed"


def test_a_frame_that_is_too_large_is_left_out(monkeypatch):
    session, metrics = SlowSession(), Metrics("agent")
    session.go.set()
    monkeypatch.setattr(
        "semcast.agent.originals.cv2.imencode", lambda *a: (True, np.zeros(17 * 1024**2, np.uint8))
    )
    sharer = OriginalSharer(session, "agent0", 1, "png", True, metrics, threading.Event())
    sharer.put(frame(0))
    sharer.put(frame(1))
    sharer.close()
    assert session.sent == []
    assert metrics.summary()["drops"]["source_invalid"] == 2
