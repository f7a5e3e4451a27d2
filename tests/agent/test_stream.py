"""Agent, channel and receiver together over loopback, started, slowed down, killed and restarted."""

import time

import msgpack
import numpy as np
import pytest
from stream_bench import Thread, take
from waiting import until

from semcast.agent.agent import run_agent
from semcast.agent.pace_control import PaceControl
from semcast.agent.settings import AgentSettings
from semcast.agent.source_settings import SourceSettings
from semcast.common.keys import link_key, status_key
from semcast.common.loopback import free_endpoint
from semcast.common.messages import LinkReport, StatusMessage
from semcast.common.network_settings import NetworkSettings
from semcast.common.transport import open_session
from semcast.common.wire import pack, unpack

pytestmark = pytest.mark.xdist_group("real-time")


def test_images_cross_the_link_and_feedback_comes_back(bench):
    channel = bench.channel(snr_db=20.0)
    receiver, agent = bench.receiver(), bench.agent(source={"repeat": "loop"})
    frames = take(receiver, count=20)
    agent.end()
    channel.end()
    for frame in frames:
        decoded = bench.codec.decode(frame.received)
        assert abs(float(decoded.image.mean()) - 20 * (frame.message.frame_id % 12)) < 6
        assert frame.camera.image_wh == (64, 48)
        assert frame.camera.codec == "tiny"
    assert np.mean([f.snr_db for f in frames]) == pytest.approx(20.0, abs=2.0)
    assert bench.codec.snrs_db[0] == 10.0, "nothing is known before the first report"
    assert np.median(bench.codec.snrs_db[5:]) == pytest.approx(20.0, abs=3.0)
    assert agent.result["counts"]["link_reports"] > 10
    assert (agent.result["source"], agent.result["complete"]) == ("steps", False)


def test_a_report_of_a_frame_that_was_never_sent_is_not_believed(bench, caplog):
    bench.channel(snr_db=20.0)
    receiver, agent = bench.receiver(), bench.agent(source={"repeat": "loop"})
    message = take(receiver, count=1)[0].message
    told = {"agent_epoch": message.agent_epoch, "t_capture_ns": message.t_capture_ns, "num_superseded": 0}
    report = pack(LinkReport(frame_id=2**40, snr_db_estimate=-4.0, **told))
    bench.hub.publisher(link_key("agent0"), "newest").put(report)
    take(receiver, count=20)
    agent.end()
    assert agent.result["drops"]["protocol"] == 1
    assert "a report must be of a frame that was sent" in caplog.text
    assert np.median(bench.codec.snrs_db[-10:]) == pytest.approx(20.0, abs=3.0)


@pytest.mark.parametrize(("rate", "coded_hw"), [("1/48", (32, 32)), ("auto", (64, 96))])
def test_frames_travel_at_the_rate_and_feedback_chooses_it(bench, rate, coded_hw):
    bench.channel(snr_db=-3.0)
    told = []
    key = status_key("agent0", "agent")
    bench.hub.subscribe(key, "every", lambda payload: told.append(unpack(payload, StatusMessage).activity))
    receiver, agent = bench.receiver(), bench.agent(rate=rate, source={"repeat": "loop"})
    frames = take(receiver, count=20)
    until(lambda: told and (rate != "auto" or "1152" in told[-1]), "the status")
    agent.end()
    assert told[-1] == ("sending 1152 channel uses a frame" if rate == "auto" else "")
    assert frames[-1].message.image_hw == coded_hw
    assert frames[-1].camera.image_wh == (64, 48)
    assert frames[-1].received.shape_hw == coded_hw
    assert frames[-1].slot_snr_db.shape == (3,), "on the camera's grid"
    if rate == "auto":
        assert frames[0].message.image_hw == (48, 64), "nothing is known before the first report"


@pytest.mark.parametrize("follow", [True, False])
def test_an_agent_sends_what_a_slow_server_can_serve(bench, follow):
    bench.channel()
    receiver = bench.receiver()
    agent = bench.agent(source={"repeat": "loop"}, follow_server=follow)  # 50 Hz
    frames = take(receiver, count=60, pause_s=0.06)
    agent.end()
    drops = agent.result["drops"]
    if not follow:
        assert "thinned" not in drops
        assert bench.metrics.drops["superseded"] > 60
        return
    gaps = np.diff([f.message.frame_id for f in frames[-20:]])
    assert np.median(gaps) >= 3
    assert drops["thinned"] > 60
    assert bench.metrics.drops.get("superseded", 0) < drops["thinned"]


def test_the_pace_knows_of_every_frame_that_is_sent(bench, monkeypatch):
    told = []
    monkeypatch.setattr(PaceControl, "on_sent", lambda pace: told.append(pace))
    bench.channel()
    receiver = bench.receiver()
    agent = bench.agent()
    take(receiver)
    agent.join(40)
    assert len(told) == agent.result["counts"]["sent"] > 0


@pytest.mark.parametrize("encode_s", [0.0, 0.07])
def test_an_agent_that_encodes_too_slowly_says_so_once_and_what_helps(bench, caplog, monkeypatch, encode_s):
    encode = bench.codec.encode

    def slow(*given):
        time.sleep(encode_s)  # the work itself
        return encode(*given)

    monkeypatch.setattr(bench.codec, "encode", slow)
    bench.channel()
    receiver = bench.receiver()
    agent = bench.agent(source={"repeat": "loop"}, follow_server=encode_s == 0)  # 50 Hz, of which 12 are sent
    take(receiver, count=25)
    agent.end()
    told = [text for text in caplog.messages if text.startswith("encoding a frame takes")]
    assert len(told) == (encode_s > 0)
    if told:
        assert "so that one in" in told[0]
        assert "a smaller --resize, a conventional codec such as jpeg-amc" in told[0]


def test_a_finite_live_source_ends_when_its_last_frame_was_seen(bench):
    bench.channel()
    receiver = bench.receiver()
    agent = bench.agent()
    frames = take(receiver)
    agent.join(40)
    assert agent.result["complete"]
    assert frames[-1].message.frame_id == 11
    not_sent = sum(agent.result["drops"].values())
    taken = len(frames) + sum(v for k, v in bench.metrics.drops.items() if k != "duplicate")
    assert taken + not_sent == 12


def test_replay_delivers_every_frame_to_a_slow_consumer(bench, caplog):
    bench.channel(channel="erasure", frame_loss=0.3)
    receiver = bench.receiver("replay")
    agent = bench.agent("replay")
    frames = take(receiver, pause_s=0.03)
    assert [f.message.frame_id for f in frames] == list(range(12))
    assert 0 < sum(f.received is None for f in frames) < 12
    agent.join(40)
    assert (agent.result["complete"], agent.result["counts"]["sent"]) == (True, 12)
    assert bench.metrics.drops == {}
    assert bench.codec.snrs_db == [10.0] * 12, "what the encoder is told does not depend on timing"
    assert "no server asks for frames" not in caplog.text


def test_a_live_server_that_takes_no_replay_is_told_of(bench, caplog, monkeypatch):
    monkeypatch.setattr("semcast.agent.agent.READY_S", 0.3)
    bench.channel()
    bench.receiver("live")
    agent = bench.agent("replay")
    until(lambda: "no server asks for frames: one in live mode takes none" in caplog.text)
    agent.end()
    assert caplog.text.count("one in live mode takes none") == 1
    assert agent.result["complete"] is False


def test_a_replay_that_no_server_is_there_for_blames_no_mode_until_one_is(bench, caplog, monkeypatch):
    monkeypatch.setattr("semcast.agent.agent.READY_S", 0.3)
    agent = bench.agent("replay", wait=False)
    until(lambda: "no server asks for frames: there is none of the name " in caplog.text)
    assert "--mode" not in caplog.text
    bench.channel()
    bench.receiver("live")
    until(lambda: "no server asks for frames: one in live mode takes none" in caplog.text)
    agent.end()
    assert caplog.text.count("no server asks for frames") == 2


def test_replay_is_the_same_every_time(bench):
    channel = bench.channel(channel="rayleigh", snr_db=5.0, frame_loss=0.2)
    receiver = bench.receiver("replay")
    runs = []
    for _ in range(2):
        agent = bench.agent("replay")
        runs.append([None if f.received is None else f.received.symbols for f in take(receiver)])
        agent.join(40)
    channel.end()
    assert len(runs[0]) == 12
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)


def test_replay_goes_on_without_a_gap_when_channel_or_server_are_restarted(bench):
    channel = bench.channel()
    receiver = bench.receiver("replay")
    agent = bench.agent("replay")
    frames = take(receiver, count=4)
    channel.end()
    bench.channel()
    frames += take(receiver, count=3)
    # A new server knows nothing of the stream, and some frames had reached the old one untaken.
    receiver.close()
    bench.hub.close()
    bench.hub = open_session(NetworkSettings(listen=(bench.endpoint,), connect=()))
    frames += take(bench.receiver("replay"))
    ids = [f.message.frame_id for f in frames]
    assert sorted(set(ids)) == list(range(12))
    assert ids[:7] == list(range(7))
    assert len(ids) - 12 <= 3, "only frames whose taking was not heard of come twice, of the last three"
    agent.join(40)
    assert agent.result["complete"]


def test_a_restarted_agent_is_followed_at_once(bench):
    bench.channel()
    receiver = bench.receiver()
    first = bench.agent(source={"repeat": "loop"})
    before = take(receiver, count=5)
    first.end()
    second = bench.agent(source={"repeat": "loop"})
    until(lambda: take(receiver, count=1)[0].message.agent_epoch > before[-1].message.agent_epoch)
    after = take(receiver, count=5)
    assert len({f.message.agent_epoch for f in after}) == 1
    assert [f.message.seq for f in after] == sorted({f.message.seq for f in after})
    second.end()
    assert second.result["agent_epoch"] == after[0].message.agent_epoch


def test_of_two_agents_of_one_name_the_one_that_is_left_out_says_so_once(bench, caplog):
    bench.channel()
    receiver = bench.receiver()
    first = bench.agent(source={"repeat": "loop"})
    take(receiver, count=2)
    second = bench.agent(source={"repeat": "loop"})
    text = "the server takes the frames of another agent 'agent0', started after this one"

    def told():
        take(receiver, count=1)
        return [r.message for r in caplog.records if r.message.startswith(text)]

    until(told)
    take(receiver, count=10)
    second.end()
    assert len(told()) == 1
    first.end()


def test_a_server_of_another_version_is_told_of_once(bench, caplog):
    server, agent = bench.hub.publisher(status_key("agent0", "server"), "newest"), bench.agent()
    another = bench.hub.publisher(status_key("agent0", "agent"), "newest")
    status = msgpack.packb({**msgpack.unpackb(pack(bench.metrics.status(1))), "version": 2})
    text = "the server takes no frames of this agent: status: protocol version must be 1, got 2: install the"

    def told():
        another.put(status)  # a second agent of this name, which takes no frames anyway
        server.put(status)
        return [r.message for r in caplog.records if "takes no frames" in r.message]

    until(told)
    agent.end()
    assert len(told()) == 1
    assert told()[0].startswith(text)


def test_an_agent_waits_for_the_others_unless_told_not_to(bench, caplog):
    caplog.set_level("INFO")
    waiting = bench.agent(source={"repeat": "loop"})
    until(lambda: "waiting for channel and server of 'agent0' (another --agent-id?)" in caplog.text)
    assert "agent" in bench.hub.alive_roles("agent0")
    channel = bench.channel()
    until(lambda: "channel" in bench.hub.alive_roles("agent0"))
    assert bench.codec.snrs_db == []
    receiver = bench.receiver()
    assert take(receiver, count=1)[0].message.seq == 0
    waiting.end()
    channel.end()
    bench.codec.snrs_db.clear()
    eager = bench.agent(wait=False)
    until(lambda: len(bench.codec.snrs_db) >= 3)
    eager.end()


def presence(caplog):
    """What the agent said of the others; the receiver says so too."""
    own = [r.message for r in caplog.records if r.name in ("semcast.agent.agent", "semcast.agent.peers")]
    return [text for text in own if text.endswith(("is gone", "is there"))]


def test_an_agent_says_when_the_channel_is_gone_and_when_it_is_back(bench, caplog):
    caplog.set_level("INFO", "semcast.agent")
    first = bench.channel()
    receiver = bench.receiver()
    bench.agent(source={"repeat": "loop"})
    take(receiver, count=1)
    first.end()
    until(lambda: presence(caplog) == ["channel is gone"])
    bench.channel()
    until(lambda: presence(caplog) == ["channel is gone", "channel is there"])


def test_an_agent_that_loses_its_hub_does_not_say_that_the_others_are_gone(bench, caplog):
    caplog.set_level("INFO", "semcast.common.transport")
    caplog.set_level("INFO", "semcast.agent")
    bench.channel()
    first = bench.receiver()
    bench.agent(source={"repeat": "loop"})
    take(first, count=1)
    bench.hub.close()
    until(lambda: "lost touch with" in caplog.text)
    assert presence(caplog) == []
    bench.hub = open_session(NetworkSettings(listen=(bench.endpoint,), connect=()))
    until(lambda: "channel is there" in caplog.text)
    take(bench.receiver(), count=1)
    until(lambda: sorted(presence(caplog)) == ["channel is there", "server is there"])


def test_an_agent_encodes_nothing_while_nobody_takes_frames(bench):
    channel = bench.channel()
    receiver = bench.receiver()
    statuses = []
    key = status_key("agent0", "agent")
    bench.hub.subscribe(key, "newest", lambda p: statuses.append(unpack(p, StatusMessage)))
    agent = bench.agent(rate="auto", source={"repeat": "loop"})
    before = take(receiver, count=1)[-1].message
    until(lambda: statuses and "sending" in statuses[-1].activity)
    channel.end()
    until(lambda: statuses and statuses[-1].drops.get("unheard"))
    num_encoded, num_unheard = len(bench.codec.snrs_db), statuses[-1].drops["unheard"]
    until(lambda: statuses[-1].drops["unheard"] > num_unheard)
    assert len(bench.codec.snrs_db) == num_encoded
    assert statuses[-1].activity == "", "it sends nothing"
    bench.channel()
    until(lambda: take(receiver, count=1)[-1].message.frame_id > before.frame_id + num_unheard)
    agent.end()
    assert agent.result["counts"]["sent"] == len(bench.codec.snrs_db) > num_encoded


def test_the_last_frame_is_sent_and_repeated_though_nobody_takes_it_yet(bench):
    channel = bench.channel()
    receiver = bench.receiver()
    agent = bench.agent(source={"pace": "rate", "rate_hz": 8.0})
    take(receiver, count=1)
    channel.end()
    agent.join(60)
    assert agent.result["complete"]
    assert agent.result["drops"]["unheard"] > 0
    assert agent.result["counts"]["sent_again"] > 0


def test_status_comes_once_a_second_and_at_the_end(bench):
    statuses = []
    bench.hub.subscribe(
        status_key("agent0", "agent"), "every", lambda p: statuses.append(unpack(p, StatusMessage))
    )
    bench.channel()
    receiver = bench.receiver()
    agent = bench.agent(source={"repeat": "loop"})
    take(receiver, count=5)
    agent.end()
    until(lambda: statuses)
    last = statuses[-1]
    assert (last.role, last.agent_epoch) == ("agent", agent.result["agent_epoch"])
    assert last.counts["sent"] == agent.result["counts"]["sent"] >= 5
    assert last.stages_ms["encode"][2] > 0


def test_a_source_that_fails_ends_the_agent_with_its_error(bench, tmp_path):
    settings = AgentSettings(source=SourceSettings(source=str(tmp_path / "nowhere")), network=bench.network)
    failing = bench._thread(lambda stop: run_agent(settings, stop, bench.codec))
    failing.join(40)
    assert "there is no such file or folder" in str(failing.error)


def test_a_last_frame_that_is_sent_again_is_counted_once(bench, monkeypatch):
    monkeypatch.setattr("semcast.agent.peers.READY_S", 0.3)  # nobody says that it is ready
    bench.channel(frame_loss=1.0)
    bench.receiver()
    agent = bench.agent(follow_server=False)
    agent.join(40)
    counts = agent.result["counts"]
    assert counts["sent"] + sum(agent.result["drops"].values()) == 12
    assert counts["sent_again"] >= 2


def test_an_agent_without_a_hub_can_be_stopped(recording, codec):
    settings = AgentSettings(
        source=SourceSettings(source=str(recording)), network=NetworkSettings(connect=(free_endpoint(),))
    )
    agent = Thread(lambda stop: run_agent(settings, stop, codec))
    agent.end()
    assert agent.error is None
    assert (agent.result["counts"], agent.result["complete"]) == ({}, False)
