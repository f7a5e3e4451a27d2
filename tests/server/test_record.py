"""A recorder beside a running system."""

import contextlib
import errno
import threading

import pytest

from semcast.common.errors import ConfigError, SourceError
from semcast.common.loopback import open_hub
from semcast.common.network_settings import NetworkSettings
from semcast.server.record import RecordSettings, run_record


def test_a_recorder_that_can_not_write_says_so_before_it_waits_for_anybody(tmp_path):
    (tmp_path / "file").write_text("no folder")
    stopped = threading.Event()
    stopped.set()
    with pytest.raises(ConfigError, match="file can't be written to"):
        run_record(RecordSettings(file=tmp_path / "file" / "run.mcap"), stopped)


def test_a_recorder_whose_disk_is_full_ends_with_an_error(tmp_path, monkeypatch):
    def no_room(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("semcast.common.recorder.RecordingWriter.add", no_room)
    hub, endpoint = open_hub()
    stop = threading.Event()
    timer = threading.Timer(20.0, stop.set)
    publisher = hub.publisher("semcast/agent0/tx/symbols", "every")
    sender = threading.Thread(target=_send_until, args=(publisher, stop))
    sender.start()
    timer.start()
    try:
        settings = RecordSettings(file=tmp_path / "run.mcap", network=NetworkSettings(connect=(endpoint,)))
        with pytest.raises(SourceError, match=r"run\.mcap is not complete: .*No space left"):
            run_record(settings, stop)
        assert not stop.is_set(), "it ends by itself"
    finally:
        stop.set()
        timer.cancel()
        sender.join(60)
        hub.close()


class StopsWhenWaitedFor(threading.Event):
    def wait(self, timeout=None):
        return True


@pytest.mark.parametrize(("agent_id", "is_told"), [("left", False), ("agent0", True)])
def test_a_recorder_of_an_agent_that_is_not_there_names_those_that_are(tmp_path, caplog, agent_id, is_told):
    hub, endpoint = open_hub()
    hub.declare_alive("left", "agent")
    network = NetworkSettings(connect=(endpoint,))
    stop = StopsWhenWaitedFor()
    with contextlib.closing(hub):
        run_record(RecordSettings(file=tmp_path / "run.mcap", agent_id=agent_id, network=network), stop)
    text = "no process of agent 'agent0' is there yet; there are those of left (--agent-id)"
    assert (text in caplog.text) == is_told


def _send_until(publisher, stop):
    while not stop.wait(0.1):
        publisher.put(b"a message")
