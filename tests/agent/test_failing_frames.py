"""Frames that can't be sent, live and in replay."""

import shutil
import threading

import pytest
from stream_bench import take
from waiting import until

from semcast.common.errors import SourceError
from semcast.common.keys import status_key
from semcast.common.messages import StatusMessage
from semcast.common.wire import unpack

pytestmark = pytest.mark.xdist_group("real-time")


class Picky:
    """Refuses one frame of twelve."""

    def __init__(self, codec, error=ValueError):
        self.name, self.digest, self.modulation = codec.name, codec.digest, codec.modulation
        self._codec, self._error = codec, error

    def encode(self, image, snr_db):
        if image[0, 0, 0] == 60:
            raise self._error("this codec can't")
        return self._codec.encode(image, snr_db)


@pytest.mark.parametrize(
    ("error", "told"), [(ValueError, "frame 3 is left out"), (RuntimeError, "encoding a frame failed")]
)
def test_a_frame_that_can_not_be_sent_live_is_left_out_and_counted(bench, caplog, error, told):
    bench.codec = Picky(bench.codec, error)
    bench.channel()
    source = {"pace": "rate", "rate_hz": 10.0}
    receiver, agent = bench.receiver(), bench.agent(follow_server=False, source=source)
    frames = take(receiver, count=5)
    agent.join(40)
    assert agent.error is None
    ids = {f.message.frame_id for f in frames}
    assert 3 not in ids
    assert max(ids) > 3
    assert agent.result["drops"]["encode"] == 1
    assert f"{told}: this codec can't" in caplog.text


def test_a_frame_that_can_not_be_encoded_ends_a_replay_that_may_leave_none_out(bench):
    bench.codec = Picky(bench.codec)
    bench.channel()
    receiver, agent = bench.receiver("replay"), bench.agent("replay")
    assert [f.message.frame_id for f in take(receiver, count=1)] == [0]
    agent.join(40)
    assert isinstance(agent.error, SourceError)
    assert str(agent.error) == "frame 3 can't be encoded, and a replay leaves none out: this codec can't"


class AfterTheSource:
    """Encodes nothing before the source has ended."""

    def __init__(self, codec):
        self.name, self.digest, self.modulation = codec.name, codec.digest, codec.modulation
        self._codec = codec

    def encode(self, image, snr_db):
        until(lambda: all(thread.name != "semcast-capture" for thread in threading.enumerate()))
        return self._codec.encode(image, snr_db)


@pytest.mark.parametrize("mode", ["live", "replay"])
def test_a_source_that_fails_while_a_frame_is_encoded_is_no_end_of_it(bench, recording, tmp_path, mode):
    bench.recording = shutil.copytree(recording, tmp_path / "damaged")
    for k in range(2, 12):
        (bench.recording / "images" / f"{k:06d}.png").write_bytes(b"")
    bench.codec = AfterTheSource(bench.codec)
    statuses = []
    bench.hub.subscribe(
        status_key("agent0", "agent"), "every", lambda p: statuses.append(unpack(p, StatusMessage))
    )
    bench.channel()
    receiver = bench.receiver(mode)
    agent = bench.agent(mode, follow_server=False)  # all of 50 Hz
    frames = take(receiver, count=2 if mode == "replay" else 1)
    agent.join(40)
    assert isinstance(agent.error, SourceError)
    assert "000011.png" in str(agent.error)
    until(lambda: bool(statuses) and statuses[-1].last_error == str(agent.error))
    assert statuses[-1].counts["sent"] == 2
    assert {f.message.frame_id for f in frames} <= {0, 1}
