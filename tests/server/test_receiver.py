import threading
import time
from dataclasses import replace

import msgpack
import numpy as np
import pytest
from receiver_ends import EPOCH, camera
from waiting import until

from semcast.common.errors import TransportError
from semcast.common.keys import channel_key, flow_key, link_key
from semcast.common.levels import Levels
from semcast.common.loopback import open_hub
from semcast.common.messages import ChannelReport, FlowMessage, LinkReport
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.phy.allocation import Allocation
from semcast.common.transport import open_client
from semcast.common.wire import pack, unpack
from semcast.server import backlog
from semcast.server.feedback import WINDOW
from semcast.server.receiver import Receiver


def test_a_row_is_as_good_as_the_slots_its_values_are_in(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    levels = np.full((4, 8), 1, np.uint8)
    levels[0] = 4  # twice the usual values: they fill the first two slots
    e.put(make_frame(3, lost=[1], allocation=Allocation(levels).code))
    frame = e.receiver.next(60)
    assert frame.received.allocation == Allocation(levels).code
    assert frame.slot_snr_db[0] == pytest.approx(0.0, abs=0.1)  # half of it arrived
    assert (frame.slot_snr_db[1:] > 15.0).all()


def test_a_frame_whose_allocation_is_none_is_dropped(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    good = make_frame(3)
    values = {**msgpack.unpackb(pack(good)), "allocation": b"\x01"}
    e.rx.put(msgpack.packb(values))
    e.put(make_frame(4))
    assert e.receiver.next(60).message.seq == 4
    assert e.metrics.drops["protocol"] == 1


def test_a_frame_is_equalised_and_reported(ends, make_frame, sent):
    e = ends()
    e.answer_camera(camera())
    reports = []
    e.client.subscribe(link_key("a"), "newest", reports.append)
    channel = e.client.publisher(channel_key("a"), "every")
    until(lambda: channel.has_receiver)
    channel.put(pack(ChannelReport(
        agent_epoch=EPOCH, frame_id=6, channel="awgn", snr_db_set=20.0, num_slots=4, num_slots_lost=1,
        frame_lost=False,
    )))  # fmt: skip
    until(lambda: e.receiver._snr_set)
    message = make_frame(3, lost=[2], levels=(5, 255, 60, 180))
    e.put(message)
    frame = e.receiver.next(60)
    assert frame.received.levels == Levels(5, 255, 60, 180)
    assert frame.message == message
    assert frame.camera == camera()
    assert frame.snr_db == pytest.approx(20.0, abs=1.5)
    assert frame.snr_db_set == 20.0
    arrived = np.array([True, True, False, True])
    np.testing.assert_allclose(frame.received.symbols[arrived], sent[0][arrived], atol=0.6)
    assert not frame.received.symbols[2].any()
    assert frame.slot_snr_db[2] == -20.0
    until(lambda: reports)
    report = unpack(reports[0], LinkReport)
    assert (report.frame_id, report.t_capture_ns) == (6, message.t_capture_ns)
    assert report.snr_db_estimate == pytest.approx(frame.snr_db)
    assert e.receiver.agent_epoch == EPOCH
    assert e.receiver.next(0.0) is None


def test_a_busy_live_consumer_loses_nothing(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    e.put(*(make_frame(seq) for seq in range(5)))
    until(lambda: e.metrics.counts.get("received") == 5)
    assert [e.receiver.next(60).message.seq for _ in range(5)] == list(range(5))
    assert e.metrics.drops == {}


def test_what_gave_way_to_newer_frames_after_the_last_one_came_is_counted_too(ends, make_frame, monkeypatch):
    e = ends()
    e.answer_camera(camera())
    e.put(make_frame(0), make_frame(1))
    until(lambda: e.metrics.counts.get("received") == 2)
    monkeypatch.setattr(backlog, "MAX_WAIT_S", 0.0)
    assert e.receiver.next(60).message.seq == 1
    assert e.metrics.drops == {"superseded": 1}


def test_a_slow_live_consumer_gets_the_newest_and_drops_are_counted_exactly(ends, make_frame, monkeypatch):
    monkeypatch.setattr(backlog, "MAX_WAIT_S", 0.0)
    e = ends()
    e.answer_camera(camera())
    reports = []
    e.client.subscribe(link_key("a"), "every", reports.append)
    ids = []
    # What came before the first frame seen of an agent is nobody's loss, so that one goes alone.
    e.put(make_frame(0))
    until(lambda: e.metrics.counts.get("received") == 1)
    for burst in range(4):
        e.put(*(make_frame(25 * burst + k) for k in range(int(burst == 0), 25)))
        until(lambda burst=burst: e.receiver._arrivals.arrived_seq == 25 * (burst + 1))
        ids.append(e.receiver.next(60).message.seq)
    assert ids == [24, 49, 74, 99]
    # What the ring itself threw away, should this machine be that busy, shows as missing.
    drops = e.metrics.drops
    assert e.metrics.counts["delivered"] + drops["superseded"] + drops.get("missing", 0) == 100
    until(lambda: len(reports) == 4)
    told = [unpack(report, LinkReport).num_superseded for report in reports]
    assert told == sorted(told)
    assert told[-1] == drops["superseded"]


def test_age_stays_within_two_frames_behind_a_consumer_five_times_too_slow(ends, make_frame, monkeypatch):
    monkeypatch.setattr(backlog, "CATCH_UP_S", 0.1)
    e = ends()
    e.answer_camera(camera())
    behind, busy = [], threading.Event()
    for newest in range(4, 75, 5):
        e.put(*(make_frame(seq) for seq in range(newest - 4, newest + 1)))
        until(lambda newest=newest: e.metrics.counts.get("received") == newest + 1)
        behind.append(newest - e.receiver.next(60).message.seq)
        busy.wait(0.05)
    assert max(behind[4:]) <= 2
    assert e.metrics.drops["superseded"] > 20


def test_old_live_frames_are_dropped(ends, make_frame):
    e = ends(max_age_ms=20_000.0)
    e.answer_camera(camera())
    e.put(make_frame(0))
    assert e.receiver.next(60).message.seq == 0
    e.put(make_frame(1, t_capture_ns=time.monotonic_ns() - 30 * 10**9), make_frame(2))
    until(lambda: e.metrics.counts["received"] == 3)
    assert e.receiver.next(60).message.seq == 2
    assert e.metrics.drops["too_old"] == 1
    e.put(make_frame(3, t_capture_ns=time.monotonic_ns() - 30 * 10**9))
    assert e.receiver.next(0.2) is None
    assert e.metrics.drops == {"too_old": 2}


def test_the_last_frame_of_a_source_is_never_too_old(ends, make_frame):
    e = ends(max_age_ms=20_000.0)
    e.answer_camera(camera())
    e.put(make_frame(0))
    assert e.receiver.next(60).message.seq == 0
    e.put(make_frame(1, t_capture_ns=time.monotonic_ns() - 30 * 10**9, final=True))
    last = e.receiver.next(60)
    assert last is not None, "without it the server would never end"
    assert last.message.final
    assert "too_old" not in e.metrics.drops


def test_bad_messages_are_counted_and_do_no_harm(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    good = pack(make_frame(0))
    for bad in (b"", b"junk", good[:-1], good + b"x", pack(camera()), pack(replace_tx(make_frame(0)))):
        e.rx.put(bad)
    nan = make_frame(0, payload=np.full(4 * 48 * 8 * 2, np.nan, "<f2").tobytes())
    e.put(make_frame(1, image_hw=(64, 112), uses_per_slot=48 * 7, payload=bytes(4 * 4 * 48 * 7)))
    until(lambda: e.metrics.drops.get("protocol") == 6 and e.metrics.counts.get("received") == 1)
    assert e.receiver.next(0.2) is None, "the image is not of the camera's size"
    assert e.metrics.drops["protocol"] == 7
    e.put(replace(nan, seq=2))
    frame = e.receiver.next(60)
    assert not frame.received.symbols.any()
    assert (frame.slot_snr_db == -20.0).all(), "samples that are no numbers count as not arrived"
    assert {k for k in e.metrics.counts if k.startswith("protocol_")} == {"protocol_syntax", "protocol_kind"}


def test_a_flood_of_nonsense_does_not_hide_what_is_wrong(ends, make_frame, caplog):
    e = ends()
    for k in range(120):
        e.rx.put(b"junk %d" % k)
        until(lambda k=k: e.metrics.drops.get("protocol") == k + 1)
    assert "not a message" in e.metrics.status(0).last_error
    assert len(caplog.records) <= 10
    values = {**msgpack.unpackb(pack(make_frame(0))), "version": 2}
    e.rx.put(msgpack.packb(values))
    until(lambda: e.metrics.drops.get("protocol") == 121)
    refused = (
        "a message was refused: symbols: protocol version must be 1, got 2: install the same version of "
        "semcast on both ends"
    )
    assert refused in caplog.text
    assert e.metrics.status(0).last_error == refused


def test_a_frame_id_out_of_nowhere_is_in_the_status(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    e.put(make_frame(0), make_frame(1, frame_id=2**62), make_frame(1))
    assert [e.receiver.next(60).message.frame_id for _ in range(2)] == [0, 2]
    assert e.metrics.drops == {"ahead": 1}
    assert e.metrics.status(0).last_error == f"frame {2**62} is left out: it can't follow frame 0"


def replace_tx(frame):
    return replace(
        frame, direction="tx", slot_lost=b"", payload_format="qam16", payload=bytes(4 * 47 * 8 // 2)
    )


def test_the_two_services_are_not_mixed(ends, make_frame, caplog):
    e = ends("live")
    e.put(make_frame(0, lossless=True), make_frame(1, lossless=True))
    until(lambda: e.metrics.drops.get("mode") == 2)
    assert caplog.text.count("the agent runs in replay mode, this server in live") == 1


def test_replay_delivers_in_order_and_says_how_far_it_is(ends, make_frame):
    e = ends("replay")
    e.answer_camera(camera(lossless=True))
    flows = []
    e.client.subscribe(flow_key("a"), "every", lambda payload: flows.append(unpack(payload, FlowMessage)))
    until(lambda: flows)
    assert flows[0] == FlowMessage(agent_epoch=0, next_seq=0, arrived_seq=0, window=WINDOW)
    e.put(*(make_frame(k, lossless=True) for k in (0, 2, 1, 1, 2)))
    until(lambda: flows and flows[-1].arrived_seq == 3)
    taken = [e.receiver.next(60).message for _ in range(3)]
    assert [message.seq for message in taken] == [0, 1, 2]
    e.receiver.done(taken[0])
    until(lambda: flows[-1].next_seq > 0)
    assert flows[-1].next_seq == 1, "the others are in work"
    e.receiver.done(taken[2])
    e.receiver.done(taken[1])
    until(lambda: flows[-1].next_seq == 3)
    assert e.metrics.drops == {"gap": 1, "duplicate": 1}


def test_a_frame_lost_on_the_air_still_counts_as_delivered_in_replay(ends, make_frame):
    e = ends("replay")
    e.answer_camera(camera(lossless=True))
    e.put(
        make_frame(0, lossless=True, payload_format="lost", payload=b"", lost=range(4)),
        make_frame(1, lossless=True),
    )
    first, second = e.receiver.next(60), e.receiver.next(60)
    assert (first.received, first.snr_db, first.slot_snr_db) == (None, None, None)
    assert second.received is not None
    assert e.metrics.counts["lost_on_air"] == 1


def test_frames_that_come_after_they_were_counted_as_missing_are_missing_no_longer(ends, make_frame):
    e = ends()
    e.put(*(make_frame(k) for k in range(5)))
    until(lambda: e.metrics.counts.get("received") == 5)
    e.receiver.count_missing(EPOCH, 10)
    assert e.metrics.drops == {"missing": 5}
    e.put(make_frame(7))
    until(lambda: e.metrics.counts.get("received") == 6)
    assert e.metrics.drops == {"missing": 4}, "5, 6, 8 and 9"
    e.receiver.count_missing(EPOCH, 10)
    assert e.metrics.drops == {"missing": 4}


def test_presence_of_the_others_is_known(ends):
    e = ends()
    e.client.declare_alive("a", "agent")
    until(lambda: e.receiver.roles_alive == {"agent"})
    e.client.close()
    until(lambda: not e.receiver.roles_alive)


def test_who_is_gone_is_not_told_where_only_the_hub_was_lost(ends, caplog):
    caplog.set_level("INFO", "semcast.server.receiver")
    e = ends()
    with open_client(NetworkSettings(connect=(e.endpoint,)), 60) as elsewhere:
        receiver = Receiver(elsewhere, "b", "live", Metrics("server"))
        e.client.declare_alive("b", "agent")
        until(lambda: receiver.roles_alive == {"agent"})
        e.hub.close()
        until(lambda: not receiver.roles_alive)
        receiver.close()
    assert [r.message for r in caplog.records if r.name == "semcast.server.receiver"] == ["agent is there"]


def test_bad_arguments_are_refused(ends):
    e = ends()
    with pytest.raises(ValueError, match="mode must be live or replay, got 'fast'"):
        Receiver(e.hub, "a", "fast", e.metrics)
    with pytest.raises(ValueError, match="max_age_ms must be positive, got 0"):
        Receiver(e.hub, "a", "live", e.metrics, max_age_ms=0)


def test_a_receiver_that_fails_to_say_how_far_it_is_says_it_the_next_time(ends, monkeypatch):
    monkeypatch.setattr("semcast.server.feedback.FLOW_INTERVAL_S", 0.01)
    with monkeypatch.context() as patch:
        patch.setattr("semcast.server.feedback.pack", lambda message: 1 / 0)
        both = ends("replay")
        until(lambda: both.metrics.counts.get("errors", 0) >= 2)
    came = threading.Event()
    both.client.subscribe(flow_key("a"), "newest", lambda payload: came.set())
    assert came.wait(10)


def test_a_receiver_that_can_not_listen_leaves_no_thread(monkeypatch):
    def refuse(*_):
        raise TransportError("no")

    hub, _ = open_hub()
    with hub:
        monkeypatch.setattr(hub, "watch_alive", refuse)
        before = set(threading.enumerate())
        with pytest.raises(TransportError, match="no"):
            Receiver(hub, "a", "replay", Metrics("server"))
        assert "semcast-flow" not in {thread.name for thread in set(threading.enumerate()) - before}
