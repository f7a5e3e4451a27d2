"""A stream over real loopback Zenoh: an agent's frames in, poses and files out."""

import contextlib
import errno
import json
import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from semcast.common.codecs import load_codec
from semcast.common.errors import SemcastError, SourceError
from semcast.common.keys import status_key
from semcast.common.loopback import free_endpoint, open_hub
from semcast.common.messages import StatusMessage
from semcast.common.metrics import Metrics
from semcast.common.network_settings import HubSettings, NetworkSettings
from semcast.common.phy.slots import layout_for
from semcast.common.run_folder import read_run
from semcast.common.symbol_payload import pack_lost
from semcast.common.trajectory import read_tum
from semcast.common.transport import open_client
from semcast.common.wire import pack, unpack
from semcast.server import server
from semcast.server.mapping.bundle_process import GIVEN_UP
from semcast.server.server import Server, run_server
from semcast.server.session import Session
from semcast.server.settings import ServerSettings
from semcast.server.view.settings import ViewSettings

pytestmark = pytest.mark.xdist_group("real-time")

DEMO = Path(__file__).resolve().parents[3] / "deploy" / "demo" / "kitti_06"
AGENT = "cam0"
DEADLINE_S = 60.0


def test_a_lossless_stream_leaves_every_promised_file_and_repeats_bit_for_bit(tmp_path, open_air, read_ply):
    trajectories = []
    for run, depth in (("a", "end"), ("b", "none")):
        out = tmp_path / run
        with open_air() as air:
            view = ViewSettings(view="file")
            running = air.serve(mode="replay", out=out, reference=DEMO, view=view, dense_cloud=depth)
            radio = air.agent(100, lossless=True)
            radio.stream(range(13))
            radio.stream([13], final=True)
            summary = running.finish()
        trajectories.append((out / "trajectory.tum").read_bytes())
        assert summary["frames"]["tracked"] == 14
        assert summary["completeness"] >= 0.9
        assert summary["ate_percent"] < 5.0
        assert summary["psnr_db"] == 100.0, "the pictures are exact"
        assert json.loads((out / "summary.json").read_text())["frames"] == summary["frames"]
        assert len(read_tum(out / "trajectory.tum")) == summary["num_posed"]
        assert len(read_ply(out / "map.ply")) == summary["num_landmarks"] > 50
        assert len(read_run(out).frame_ids) == summary["num_posed"]
        assert (out / "run.rrd").stat().st_size > 10_000
        assert "[reconstruction]" in (out / "settings.toml").read_text()
        assert set(radio.posed_ids()) == set(range(14))
    assert len(read_ply(tmp_path / "a" / "dense.ply")) > 1000
    assert trajectories[0] == trajectories[1]


@pytest.mark.parametrize("stop", [True, False], ids=["stopped", "complete"])
def test_a_stream_is_saved_and_released_where_the_adjustment_at_its_end_is_broken_off(
    air, tmp_path, monkeypatch, stop
):
    def break_off(session):
        raise RuntimeError("a second Ctrl-C")

    monkeypatch.setattr("semcast.server.session.Session.conclude", break_off)
    running = air.serve(out=tmp_path, save_images="all")
    radio = air.agent(100)
    radio.stream(range(11))
    radio.stream([11], final=not stop)
    with pytest.raises(RuntimeError, match="second Ctrl-C"):
        running.finish(stop=stop)
    assert len(read_run(tmp_path).frame_ids) >= 8
    names = {thread.name for thread in threading.enumerate()}
    assert names.isdisjoint({"semcast-checkpoint", "semcast-images"})


def test_the_status_says_at_once_what_the_end_of_a_stream_waits_for(air, monkeypatch, caplog):
    monkeypatch.setattr("semcast.common.status_beat.STATUS_INTERVAL_S", 1000.0)
    monkeypatch.setattr("semcast.server.conclusion._MANY", 2)
    monkeypatch.setattr("semcast.server.conclusion._LOG_INTERVAL_S", 0.0)
    caplog.set_level("INFO", logger="semcast.server.conclusion")
    told = []

    def hear(payload):
        if (activity := unpack(payload, StatusMessage).activity) not in told[-1:]:
            told.append(activity)

    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        client.subscribe(status_key(AGENT, "server"), "every", hear)
        running = air.serve(dense_cloud="end")
        radio = air.agent(100)
        for k in range(14):  # one at a time: a busy server would leave some out, and have fewer keyframes
            radio.stream([k])
            until(lambda k=k: running.server._sessions.current.last_frame_id == k)
        running.finish(stop=True)
        end_s = time.monotonic() + DEADLINE_S
        while "writing results" not in told:
            assert time.monotonic() < end_s, told
            time.sleep(0.01)
    first, *depths, last = told
    assert re.fullmatch(r"last adjustment of \d+ keyframes", first)
    done, in_all = zip(*(map(int, re.findall(r"\d+", text)) for text in depths), strict=True)
    assert depths == [f"depth {k} of {num} keyframes" for k, num in zip(done, in_all, strict=True)]
    assert done[0] == 0
    assert list(done) == sorted(set(done)), "those without neighbours are passed over"
    assert len(done) > 3
    assert set(in_all) == {done[-1]}
    assert last == "writing results"
    assert first in caplog.text
    assert depths[-1] in caplog.text


def test_an_adjustment_is_applied_while_no_frame_comes(air):
    running = air.serve()
    radio = air.agent(100)
    for k in range(10):
        radio.stream([k])
        session = running.server._sessions.current
        until(lambda k=k, session=session: session.last_frame_id == k and not session.is_adjusting)
    running.finish(stop=True)


def test_bad_frames_are_counted_and_never_stop_the_stream(air):
    running = air.serve()
    radio = air.agent(100)
    radio.stream([0, 1])
    radio._symbols.put(b"\x93garbage")
    radio.send(2, digest="0" * 16)
    running.wait_for_drop("codec")  # live: a newer frame would replace it unseen
    layout = layout_for(air.sequence.size_wh[::-1])
    radio.send(3, slot_lost=pack_lost(np.ones(layout.num_slots, bool)))
    running.wait_for_drop("outage")
    radio.stream([4, 5])
    radio.stream([9], seq=6)  # frames 6 to 8 were not sent
    summary = running.finish(stop=True)
    assert summary["drops"]["protocol"] == 1
    assert summary["drops"]["codec"] == 1
    assert summary["drops"]["outage"] == 1
    assert (summary["frames"]["tracked"], summary["frames"]["sent"]) == (5, 7)


def test_frames_that_can_not_be_tracked_are_counted_and_why_is_logged_once(air, monkeypatch, caplog):
    process = Session.process

    def fails_early(self, frame, *args, **kwargs):
        if frame.frame_id < 3:
            raise np.linalg.LinAlgError("singular")
        return process(self, frame, *args, **kwargs)

    monkeypatch.setattr(Session, "process", fails_early)
    running = air.serve()
    radio = air.agent(100)
    for k in range(3):
        radio.send(k)
        until(lambda k=k: running.server.metrics.drops.get("track") == k + 1)
    radio.stream([3])
    assert running.server.metrics.status(0).last_error == "tracking a frame failed: singular"
    assert running.finish(stop=True)["drops"]["track"] == 3
    assert [r.getMessage() for r in caplog.records if "singular" in r.getMessage()] == [
        "tracking a frame failed: singular"
    ]


def test_a_frame_that_waited_too_long_for_the_tracker_is_dropped(air, monkeypatch):
    process, begun, go_on = Session.process, threading.Event(), threading.Event()

    def hold_up(session, frame, *rest):
        if frame.frame_id == 1:
            begun.set()
            assert go_on.wait(DEADLINE_S)
        return process(session, frame, *rest)

    monkeypatch.setattr(Session, "process", hold_up)
    running = air.serve(max_age_ms=1e6)
    radio = air.agent(100)
    radio.stream([0])
    radio.send(1)
    assert begun.wait(DEADLINE_S)
    # Old when it comes, and too old by the time that it was decoded and waits.
    radio.send(2, t_capture_ns=time.monotonic_ns() - 500 * 10**9)
    until(lambda: running.server._ahead._slot is not None)
    monkeypatch.setattr(running.server._receiver, "_max_age_ms", 400e3)
    go_on.set()
    running.wait_for_drop("too_old")
    radio.stream([3])
    assert 2 not in radio.posed_ids()
    running.finish(stop=True)


def test_a_stream_has_not_ended_while_a_frame_is_between_network_and_decoder(air, monkeypatch):
    monkeypatch.setattr("semcast.server.stream_end.AGENT_GONE_S", 1000.0)
    running = air.serve(duration_s=DEADLINE_S)
    radio = air.agent(100)
    radio.stream([0])
    metrics = Metrics("agent")
    metrics.end()
    status = radio.session.publisher(status_key(AGENT, "agent"), "every")
    status.put(pack(metrics.status(radio.epoch)))
    until(lambda: running.server._end_of.num_sent(radio.epoch) is not None)
    assert not running.server._ended(2000.0), "the tracker took long, and the frame came just now"
    monkeypatch.setattr("semcast.server.stream_end.AGENT_GONE_S", 0.0)
    until(lambda: running.server._end_of.complete)
    running.finish()


def test_a_bundle_adjustment_that_gave_up_is_in_the_status(air):
    running = air.serve(bundle="process", duration_s=0.1)
    running.server._sessions._spare_bundle._give_up()
    assert running.server.metrics.status(0).last_error == GIVEN_UP
    running.finish()


def test_a_server_that_hears_nothing_ends_with_its_time_limit(air):
    running = air.serve(duration_s=0.2)
    assert running.finish() == {}


def test_a_server_that_ends_says_whose_processes_met_at_it(caplog):
    stop, endpoint = threading.Event(), free_endpoint()
    settings = ServerSettings(network=HubSettings(listen=(endpoint,)), view=ViewSettings(view="none"))
    serving = threading.Thread(target=run_server, args=(settings, stop))
    serving.start()
    with open_client(NetworkSettings(connect=(endpoint,)), DEADLINE_S) as other:
        other.declare_alive("right", "agent")
        until(lambda: other.alive_roles(settings.agent_id))
        stop.set()
        serving.join(DEADLINE_S)
    assert "right met at this server and can't go on without it" in caplog.text
    assert settings.agent_id not in caplog.messages[-1]


def test_a_silent_stream_ends_with_the_idle_limit_and_its_outputs(tmp_path, air):
    running = air.serve(out=tmp_path, idle_timeout_s=0.3)
    radio = air.agent(100)
    radio.send(0)  # a busy machine could be silent for as long before a second one
    assert running.finish()["frames"]["tracked"] == 1
    assert (tmp_path / "summary.json").exists()


def test_the_idle_limit_counts_from_the_first_frame_however_long_ago_the_server_was_started(air):
    running = air.serve(idle_timeout_s=0.3)
    assert not running.stop.wait(0.4)
    radio = air.agent(100)
    radio.wait(lambda: radio.allowed > 0, "word that the server is ready")
    assert not running.stop.wait(0.4)
    assert running.thread.is_alive()
    radio.send(0)
    assert running.finish()["frames"]["tracked"] == 1


def test_a_server_decodes_with_weights_of_ones_own(tiny_weights):
    hub, _ = open_hub()
    own = load_codec(str(tiny_weights))
    settings = ServerSettings(agent_id=AGENT, bundle="inline", codec=str(tiny_weights))
    with hub, contextlib.closing(Server(settings, hub)) as server:
        decoder = server._decoder
        assert decoder.codec_for("3dcsc", "16qam", own.digest).digest == own.digest
        with pytest.raises(SemcastError, match="or give both the same weights"):
            decoder.codec_for("3dcsc", "16qam", load_codec("3dcsc").digest)
        shipped = load_codec("3dcsc-lite").digest
        assert decoder.codec_for("3dcsc-lite", "16qam", shipped).digest == shipped


def test_a_recording_that_breaks_off_leaves_the_results_and_is_an_error_at_the_end(
    air, tmp_path, monkeypatch
):
    def no_room(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("semcast.common.recorder.RecordingWriter.add", no_room)
    running = air.serve(out=tmp_path / "run", record=tmp_path / "run.mcap")
    radio = air.agent(100)
    radio.stream(range(3))
    with pytest.raises(SourceError, match=r"run\.mcap is not complete: .*No space left"):
        running.finish(stop=True)
    status = running.server.metrics.status(0)
    assert status.last_error.endswith("run.mcap ended: No space left on device")
    assert running.summary["frames"]["tracked"] == 3
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"]["tracked"] == 3


def test_a_recording_that_is_not_whole_hides_no_output_that_could_not_be_written(monkeypatch):
    class Full:
        def __init__(self, settings, session):
            self.is_open = True

        def run(self, stop):
            raise SemcastError("outputs can't be written")

        def close(self):
            was_open, self.is_open = self.is_open, False
            if was_open:
                raise SourceError("run.mcap is not complete")

    monkeypatch.setattr(server, "Server", Full)
    settings = ServerSettings(network=HubSettings(listen=(free_endpoint(),)))
    with pytest.raises(SemcastError, match=r"^outputs can't be written; run.mcap is not complete$"):
        run_server(settings, threading.Event())


@pytest.mark.parametrize("num_seen", [0, 5])
def test_a_stream_whose_end_is_lost_ends_and_says_what_is_missing(air, num_seen):
    running = air.serve()
    radio = air.agent(100)
    radio.stream(range(num_seen))
    metrics = Metrics("agent")
    for _ in range(20):
        metrics.count("sent")
    metrics.end()
    radio.session.publisher(status_key(AGENT, "agent"), "newest").put(pack(metrics.status(100)))
    summary = running.finish()
    assert summary["frames"] == {
        "source": 24, "sent": 20, "tracked": num_seen, "posed": summary["num_posed"],
        "keyframes": summary["frames"]["keyframes"],
    }  # fmt: skip
    assert summary["drops"]["missing"] == 20 - num_seen
    assert summary["unposed_frames"][-1][1] == 19


def test_an_agent_that_was_there_before_goes_on_when_one_of_the_same_name_has_ended(air):
    running = air.serve()
    first, second = air.agent(100), None
    first.stream(range(4))
    second = air.agent(200)
    second.stream(range(3))
    second.stream([3], final=True)
    second.close()
    deadline_s = time.monotonic() + DEADLINE_S
    k = 4
    while not set(first.posed_ids()) & set(range(4, 24)):
        assert time.monotonic() < deadline_s
        first.send(min(k, 22), seq=k, frame_id=k, final=False)
        k += 1
        time.sleep(0.2)
    running.finish(stop=True)
    assert running.server.metrics.drops["epoch"] > 0, "while the second was sending"
