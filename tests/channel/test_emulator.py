import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import numpy as np
import pytest
from waiting import came_true, until

from semcast.channel import emulator
from semcast.channel.emulator import Emulator, run_channel, set_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.channel.silence import Silence
from semcast.common.codec import EncodedImage
from semcast.common.errors import ConfigError, SemcastError, TransportError
from semcast.common.keys import channel_key, rx_key, status_key, tx_key
from semcast.common.loopback import open_hub
from semcast.common.messages import ChannelReport, StatusMessage, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.phy.pilots import insert_pilots
from semcast.common.phy.qam import constellation
from semcast.common.symbol_payload import lost_slots_of, pack_data_symbols, slots_of
from semcast.common.transport import open_client
from semcast.common.wire import pack, unpack

pytestmark = pytest.mark.xdist_group("real-time")

HW = (64, 128)
PROGRAM = """
import sys, threading, signal
from semcast.channel.emulator import run_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.common.network_settings import NetworkSettings
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
summary = run_channel(EmulatorSettings(agent_id="a", network=NetworkSettings(connect=(sys.argv[1],))), stop)
print(summary["counts"].get("carried", 0))
"""


@pytest.fixture(scope="module")
def symbols():
    return constellation()[np.random.default_rng(3).integers(0, 16, (4, 47 * 8))]


@pytest.fixture(scope="module")
def make(symbols):
    payload_format, payload = pack_data_symbols(EncodedImage(HW, symbols, "16qam"))

    def make_frame(seq, epoch=1, **changes):
        values = {
            "agent_epoch": epoch, "seq": seq, "frame_id": seq, "t_capture_ns": 0, "t_source_ns": seq * 10**8,
            "codec": "x", "digest": "", "image_hw": HW, "modulation": "16qam", "num_slots": 4,
            "uses_per_slot": 48 * 8, "direction": "tx", "payload_format": payload_format, "payload": payload,
        }  # fmt: skip
        return SymbolFrame(**{**values, **changes})

    return make_frame


class Ends:
    """A channel process in a thread, and what agent and server see of it."""

    def __init__(self, link, seed=0):
        self.hub, endpoint = open_hub()
        self.network = NetworkSettings(connect=(endpoint,))
        self.received, self.reports, self.status = [], [], []
        self.hub.subscribe(rx_key("a"), "every", lambda p: self.received.append(unpack(p, SymbolFrame)))
        self.hub.subscribe(channel_key("a"), "every", lambda p: self.reports.append(unpack(p, ChannelReport)))
        self.hub.subscribe(
            status_key("a", "channel"), "every", lambda p: self.status.append(unpack(p, StatusMessage))
        )
        self.tx = self.hub.publisher(tx_key("a"), "every")
        self.stop = threading.Event()
        settings = EmulatorSettings(agent_id="a", seed=seed, link=link, network=self.network)
        self.summary = {}
        self.thread = threading.Thread(target=lambda: self.summary.update(run_channel(settings, self.stop)))
        self.thread.start()
        until(lambda: "channel" in self.hub.alive_roles("a") and self.tx.has_receiver)

    def pass_one(self, frame):
        """Send a frame and wait until the channel reports on it."""
        before = len(self.reports)
        self.tx.put(pack(frame))
        until(lambda: len(self.reports) > before)

    def close(self):
        self.stop.set()
        self.thread.join(60)
        self.hub.close()


@pytest.fixture
def ends():
    opened = []

    def open_ends(seed=0, **link):
        opened.append(Ends(ChannelSettings(**link), seed))
        return opened[-1]

    yield open_ends
    for one in opened:
        one.close()


def test_frames_come_out_as_the_link_model_makes_them(ends, make, symbols):
    e = ends(channel="erasure", snr_db=6.0, slot_loss=0.4, seed=7)
    for k in range(5):
        e.pass_one(make(k))
    until(lambda: len(e.received) == 5)
    link = Link(ChannelSettings(channel="erasure", snr_db=6.0, slot_loss=0.4), seed=7)
    some_lost = 0
    for k, frame in enumerate(e.received):
        expected = link.transmit(insert_pilots(symbols), k * 0.1, k)
        np.testing.assert_allclose(slots_of(frame), expected.slots_rx, atol=5e-3)
        np.testing.assert_array_equal(lost_slots_of(frame), expected.slot_lost)
        some_lost += int(expected.slot_lost.sum())
        assert (frame.direction, frame.frame_id, frame.seq) == ("rx", k, k)
        assert e.reports[k].num_slots_lost == expected.slot_lost.sum()
    assert some_lost > 0
    assert (e.reports[0].snr_db_set, e.reports[0].channel) == (6.0, "erasure")


def test_who_comes_and_goes_and_that_nothing_comes_is_told(ends, make, monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(emulator, "Silence", partial(Silence, silence_s=0.3))
    e = ends()
    with open_client(e.network, 5.0) as agent:
        agent.declare_alive("a", "agent")
        until(lambda: "agent is there" in caplog.text)
        until(lambda: "no frame of agent 'a' has come" in caplog.text)
        e.pass_one(make(0))
        until(lambda: caplog.text.count("no frame of agent 'a' has come") == 2)
    until(lambda: "agent is gone" in caplog.text)


def test_settings_change_while_it_runs_and_bad_ones_are_refused(ends, make, caplog):
    caplog.set_level("INFO", logger="semcast.channel.emulator")
    e = ends(snr_db=10.0)
    e.pass_one(make(0))
    assert set_channel(e.network, "a", {"snr_db": 4.0})["snr_db"] == 4.0
    e.pass_one(make(1))
    assert [r.snr_db_set for r in e.reports] == [10.0, 4.0]
    for changes, message in (
        ({"snr_db": 99.0}, r"snr_db must be in \[.*\], got 99"),
        ({"snr_bd": 3.0}, "unknown setting 'snr_bd', did you mean 'snr_db'"),
        ({"channel": "awgm"}, "channel must be one of .*did you mean 'awgn'"),
        ({"channel": "trace", "trace": "file", "trace_file": "/nowhere.csv"}, "nowhere.csv"),
    ):
        with pytest.raises(ConfigError, match=message):
            set_channel(e.network, "a", changes)
    now = set_channel(e.network, "a", {})
    assert (now["snr_db"], now["channel"]) == (4.0, "awgn")
    assert set_channel(e.network, "a", {"channel": "rayleigh"})["channel"] == "rayleigh"
    changed = [line for line in caplog.messages if line.startswith("channel set")]
    assert changed == ["channel set: snr_db=4.0", "channel set: channel=rayleigh"]
    e.pass_one(make(2))
    assert e.reports[-1].channel == "rayleigh"


def test_no_trace_file_stops_the_stream_or_tells_what_is_in_it(ends, make, tmp_path):
    e = ends()
    e.pass_one(make(0))
    secret, pipe = tmp_path / "secret", tmp_path / "pipe"
    secret.write_text("password=1234\n")
    os.mkfifo(pipe)
    for file, message in ((secret, "must name the columns t_s,snr_db"), (pipe, "must be a file with an SNR")):
        with pytest.raises(ConfigError, match=message) as refused:
            set_channel(e.network, "a", {"channel": "trace", "trace": "file", "trace_file": str(file)})
        assert "1234" not in str(refused.value)
    e.pass_one(make(1))


def test_a_trace_file_whose_name_is_no_text_does_not_silence_the_channel(ends, tmp_path):
    file = tmp_path / os.fsdecode(b"walk\xff.csv")
    file.write_text("t_s,snr_db\n0,7\n")
    e = ends(channel="trace", trace="file", trace_file=file)
    in_force = set_channel(e.network, "a", {"frame_loss": 0.5})
    assert (in_force["frame_loss"], in_force["trace_file"]) == (0.5, f"{tmp_path}/walk?.csv")
    with pytest.raises(SemcastError, match="settings must be text that UTF-8 can hold"):
        set_channel(e.network, "a", {"trace_file": str(file)})


def test_nobody_to_set_is_said(ends):
    e = ends()
    with pytest.raises(TransportError, match=r"no channel of other answers.*running\?$"):
        set_channel(e.network, "other", {"snr_db": 4.0})
    with open_client(e.network, 5.0) as agents:
        agents.declare_alive("other", "agent")
        agents.declare_alive("left", "agent")
        with pytest.raises(TransportError, match="--agent-id says which is meant; there are agents left$"):
            set_channel(e.network, "other", {"snr_db": 4.0})


def test_lost_frames_never_arrive_live_but_are_announced_in_replay(ends, make):
    e = ends(frame_loss=1.0)
    e.pass_one(make(0))
    e.pass_one(make(0, epoch=2, lossless=True))
    until(lambda: e.received)
    assert [(f.agent_epoch, f.payload_format, f.payload) for f in e.received] == [(2, "lost", b"")]
    assert lost_slots_of(e.received[0]).all()
    assert all(r.frame_lost for r in e.reports)


def test_replay_loses_nothing_even_in_a_burst_and_live_counts_what_it_drops(ends, make):
    e = ends()
    for k in range(10):
        e.tx.put(pack(make(k, lossless=True)))
    until(lambda: len(e.received) == 10)
    assert [f.seq for f in e.received] == list(range(10))
    # What came before the first frame seen of an agent is nobody's loss, so that one goes alone.
    e.pass_one(make(0, epoch=2))
    for k in range(1, 200):
        e.tx.put(pack(make(k, epoch=2)))
    sent = 200
    # Live frames may also be dropped behind the channel, even the last of the burst: then one more is sent.
    while not came_true(lambda last=sent - 1: e.received[-1].seq == last, 1.0):
        assert sent < 220
        e.tx.put(pack(make(sent, epoch=2)))
        sent += 1
    e.close()
    drops, carried = e.summary["drops"], e.summary["counts"]["carried"] - 10
    assert carried + drops.get("superseded", 0) + drops.get("missing", 0) == sent
    assert 2 <= sum(f.agent_epoch == 2 for f in e.received) <= carried


def test_a_number_out_of_nowhere_opens_no_gap_and_a_long_break_of_the_link_does(ends, make):
    e = ends()
    for seq in (0, 1, 2**62, 2, 4):
        e.pass_one(make(seq, t_source_ns=0))
    for seq in (5000, 5001):
        e.pass_one(make(seq))
    e.close()
    assert e.summary["drops"] == {"missing": 1 + 4995}
    assert e.summary["counts"]["carried"] == 7


def test_frames_that_are_sent_again_are_not_taken_for_gaps(ends, make):
    e = ends()
    for seq in (0, 1, 2, 3, 1, 2, 4, 5, 8):
        e.pass_one(make(seq, lossless=True))
    for seq in (3, 4, 6):
        e.pass_one(make(seq, epoch=2, lossless=True))
    e.close()
    assert e.summary["drops"] == {"missing": 3}, "6 and 7 of the first start, 5 of the second"
    counts = e.summary["counts"]
    assert (counts["received"], counts["carried"], counts["carried_again"]) == (12, 10, 2)


def test_a_frame_that_is_lost_over_and_over_is_lost_once(ends, make):
    e = ends(frame_loss=1.0)
    for seq in (0, 1, 1, 1):
        e.pass_one(make(seq))
    e.close()
    assert e.summary["drops"] == {"lost": 2}


def test_delay_is_added(ends, make):
    e = ends(delay_ms=150.0)
    started_s = time.monotonic()
    e.tx.put(pack(make(0)))
    until(lambda: e.received)
    assert time.monotonic() - started_s >= 0.15


@pytest.mark.parametrize("delay_ms", [0.0, 20.0])
def test_what_can_not_be_sent_on_is_counted_and_told(make, delay_ms):
    hub, _ = open_hub()
    metrics = Metrics("channel")
    channel = Emulator(hub, EmulatorSettings(link=ChannelSettings(delay_ms=delay_ms)), metrics)
    channel._live._publisher.undeclare()
    channel._carry(make(0))
    until(lambda: metrics.drops == {"unsent": 1}, "it is counted")
    assert "rx/symbols can't be sent" in metrics.status(0).last_error
    channel.close()
    hub.close()


def test_bad_messages_are_counted_and_told_and_do_no_harm(ends, make, caplog):
    e = ends()
    nan = make(0, payload_format="iq16", payload=b"\x00\x7e" * (2 * 4 * 47 * 8))
    for bad in (b"", b"junk", pack(make(0))[:-2], pack(nan)):
        e.tx.put(bad)
    until(lambda: e.status and e.status[-1].drops.get("protocol") == 4)
    assert "a message was refused: symbols: bytes are not a message" in caplog.text
    assert "frame 0 is left out: symbols must be finite" in caplog.text
    silent = make(1, epoch=3, payload_format="iq16", payload=bytes(4 * 4 * 47 * 8))
    e.pass_one(silent)
    e.pass_one(make(0, epoch=4))
    until(lambda: len(e.received) == 2)
    assert e.status[-1].role == "channel"
    assert [f.agent_epoch for f in e.received] == [3, 4]
    e.tx.put(pack(e.received[0]))
    until(lambda: e.status[-1].drops.get("protocol") == 5)
    assert "frame must be tx, got rx" in caplog.text


def test_an_error_nobody_foresaw_takes_one_frame_and_not_the_channel(ends, make, monkeypatch, caplog):
    insert = emulator.insert_pilots

    def fails_once(symbols):
        monkeypatch.setattr(emulator, "insert_pilots", insert)
        raise MemoryError("no memory")

    e = ends()
    monkeypatch.setattr(emulator, "insert_pilots", fails_once)
    e.tx.put(pack(make(0)))
    until(lambda: e.status and e.status[-1].drops.get("carry") == 1)
    e.pass_one(make(1))
    until(lambda: [f.seq for f in e.received] == [1])
    assert "carrying a frame failed: no memory" in caplog.text


def test_a_process_ends_cleanly_on_sigterm_and_another_takes_over_after_a_kill(make):
    hub, endpoint = open_hub()
    received = []
    hub.subscribe(rx_key("a"), "every", received.append)
    tx = hub.publisher(tx_key("a"), "every")

    def start():
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, endpoint],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip

    def passes():
        tx.put(pack(make(0)))
        return bool(received)

    processes = [start()]
    try:
        with hub:
            until(passes)
            processes[0].kill()
            until(lambda: "channel" not in hub.alive_roles("a"))
            received.clear()
            processes.append(start())
            until(passes)
            processes[1].send_signal(signal.SIGTERM)
            out, err = processes[1].communicate(timeout=60)
            assert (processes[1].returncode, err) == (0, "")
            assert int(out) >= 1
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def test_a_channel_without_a_hub_can_be_stopped():
    stop = threading.Event()
    network = NetworkSettings(connect=("tcp/127.0.0.1:9",))
    summary = []
    thread = threading.Thread(
        target=lambda: summary.append(run_channel(EmulatorSettings(network=network), stop))
    )
    thread.start()
    stop.set()
    thread.join(60)
    assert summary == [{"counts": {}, "drops": {}, "stage_ms": {}}]


def test_a_trace_that_is_not_there_is_told_before_waiting_for_a_hub(tmp_path):
    settings = EmulatorSettings(
        link=ChannelSettings(channel="trace", trace="file", trace_file=tmp_path / "none.csv"),
        network=NetworkSettings(connect=("tcp/127.0.0.1:9",)),
    )
    with pytest.raises(ConfigError, match="none.csv"):
        run_channel(settings, threading.Event())


def test_the_log_names_the_file_that_the_snr_is_of(tmp_path, caplog):
    file = tmp_path / "drive.csv"
    file.write_text("t_s,snr_db\n0,12\n")
    caplog.set_level("INFO", "semcast.channel.emulator")
    for link in (
        ChannelSettings(channel="trace", trace="file", trace_file=file),
        ChannelSettings(channel="trace", snr_db=8.0),
        ChannelSettings(channel="rayleigh", snr_db=8.0),
    ):
        Ends(link).close()
    said = [record.getMessage() for record in caplog.records]
    for words in (f"channel trace, SNR: that of {file}", "trace, SNR: ramp from 8 dB", "rayleigh, SNR: 8 dB"):
        assert any(line.endswith(words) for line in said), words


def test_settings_are_checked():
    with pytest.raises(ValueError, match="seed must be at least 0, got -1"):
        EmulatorSettings(seed=-1)
    with pytest.raises(ValueError, match="agent_id must be"):
        EmulatorSettings(agent_id="a/b")


@pytest.mark.parametrize("at", ["answer", "declare_alive"])
def test_a_channel_that_fails_to_start_ends_its_threads(monkeypatch, at):
    def fail(self, *_):
        raise TransportError("the session is closed")

    monkeypatch.setattr(f"semcast.common.transport.Session.{at}", fail)
    before = set(threading.enumerate())
    hub, endpoint = open_hub()
    with hub:
        settings = EmulatorSettings(agent_id="a", network=NetworkSettings(connect=(endpoint,)))
        with pytest.raises(TransportError, match="the session is closed"):
            run_channel(settings, threading.Event())
    left = {thread.name for thread in set(threading.enumerate()) - before}
    assert not {name for name in left if name.startswith("semcast")}
