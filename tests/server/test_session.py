"""One start of an agent, frame by frame, without a network."""

import threading
import time

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.server.mapping.state import DecodedFrame
from semcast.server.reference import Reference
from semcast.server.session import Arrival, Session, StreamIdentity
from semcast.server.settings import ServerSettings

CAMERA = Intrinsics(fx=60, fy=60, cx=47.5, cy=31.5, width=96, height=64)
IDENTITY = StreamIdentity(agent_id="a", agent_epoch=5, codec="x", digest="", camera=CAMERA, num_frames=None)
IMAGE = np.full((64, 96, 3), 99, np.uint8)


@pytest.fixture
def process():
    """Opens a session with a reference; what it gives processes a frame and returns its PSNR."""
    opened = []

    def open_session(reference, **settings):
        session = Session(ServerSettings(bundle="inline", **settings), IDENTITY, None, reference)
        opened.extend((session, reference))

        def one(frame_id):
            frame = DecodedFrame(frame_id, frame_id * 10**8, IMAGE, None)
            now_ns = time.perf_counter_ns()
            outcome = session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
            return outcome.view.scalars.get("link/psnr_db")

        return one

    yield open_session
    for one in opened:
        one.close()


def test_a_slow_reference_holds_only_the_frame_up_that_asked_it(process, monkeypatch):
    wait_s = 1.0
    monkeypatch.setattr("semcast.server.session.LIVE_PSNR_WAIT_S", wait_s)
    asked, readable = [], threading.Event()

    def original(frame_id):
        asked.append(frame_id)
        readable.wait(60)
        return IMAGE

    one = process(Reference(original))
    started_s = time.monotonic()
    assert [one(k) for k in range(6)] == [None] * 6
    assert time.monotonic() - started_s < 3 * wait_s, "one frame waited, not six"
    readable.set()
    end_s = time.monotonic() + 20
    last = 6
    while (psnr_db := one(last)) is None:
        assert time.monotonic() < end_s
        last += 1
    assert psnr_db == 100.0
    assert asked == [0, last]


def test_in_replay_every_frame_waits_for_its_psnr(process):
    one = process(Reference(lambda frame_id: IMAGE), mode="replay")
    assert [one(k) for k in range(3)] == [100.0] * 3
