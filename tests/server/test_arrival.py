from dataclasses import fields, replace

import msgpack
import pytest

from semcast.common.message_fields import MAX_COUNT
from semcast.common.messages import FlowMessage, StatusMessage, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.wire import WireError, pack, unpack
from semcast.server.arrival import Arrivals, CaptureAge

MS = 1_000_000


def frame(seq, epoch=1, base_seq=0, lossless=False):
    return SymbolFrame(
        agent_epoch=epoch, seq=seq, base_seq=base_seq, frame_id=seq, t_capture_ns=seq * MS, t_source_ns=0,
        codec="x", digest="", image_hw=(16, 16), modulation="16qam", num_slots=1, uses_per_slot=48,
        direction="rx", payload_format="iq16", payload=bytes(192), slot_lost=b"\0", lossless=lossless,
    )  # fmt: skip


@pytest.fixture
def metrics():
    return Metrics("server")


def accepted(arrivals, frames, arrival_ns=1):
    return [f.seq for f in frames if arrivals.accept(f, arrival_ns)]


def test_live_takes_only_what_is_newer_and_counts_the_rest(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert accepted(arrivals, [frame(k) for k in (5, 6, 6, 9, 7, 7, 10, 5)]) == [5, 6, 9, 10]
    # 8 never came; 7 came late; 6, 7 and 5 came twice.
    assert metrics.drops == {"duplicate": 3, "missing": 1, "stale": 1}


def test_every_live_frame_is_accounted_for_exactly(metrics, rng):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    sent = list(range(200))
    arrives = [k for k in sent[1:-1] if rng.random() > 0.2]
    order = [0, *sorted(arrives, key=lambda k: k + rng.normal(0, 2)), 199]
    taken = accepted(arrivals, [frame(k) for k in order])
    assert taken == sorted(taken)
    assert len(taken) + metrics.drops["missing"] + metrics.drops["stale"] == len(sent)
    assert metrics.drops["missing"] == len(sent) - len(order)


def test_frames_before_the_first_one_seen_are_not_missing(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert accepted(arrivals, [frame(1000), frame(999), frame(1001)]) == [1000, 1001]
    assert metrics.drops == {"stale": 1}


def test_one_number_out_of_nowhere_does_not_shut_out_the_stream(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert accepted(arrivals, [frame(k) for k in (0, 1, MAX_COUNT - 2, 2, 4)]) == [0, 1, 2, 4]
    assert metrics.drops == {"ahead": 1, "missing": 1}


def test_a_stream_that_begins_with_a_wrong_number_is_taken_up_at_once(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert accepted(arrivals, [frame(MAX_COUNT - 2), *map(frame, range(60))])[1:] == list(range(2, 60))
    assert metrics.drops == {"stale": 2}


def test_the_stream_of_a_restarted_agent_that_begins_with_a_wrong_number_is_taken_up_at_once_too(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    former = [frame(k) for k in range(5)]
    new = [frame(k, epoch=2) for k in (MAX_COUNT - 2, *range(10))]
    assert accepted(arrivals, [*former, *new])[5:] == [MAX_COUNT - 2, *range(2, 10)]


def test_a_lossless_stream_that_begins_with_a_wrong_number_is_taken_up_at_once(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    far = frame(MAX_COUNT - 2, base_seq=MAX_COUNT - 2, lossless=True)
    frames = [frame(k, base_seq=0, lossless=True) for k in (0, 1, 2, 0, 1, 2, 3)]
    assert accepted(arrivals, [far, *frames]) == [MAX_COUNT - 2, 0, 1, 2, 3]
    assert metrics.drops == {"duplicate": 2, "gap": 1}


def test_one_confirmation_out_of_nowhere_does_not_end_a_lossless_stream(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    frames = [frame(k, lossless=True) for k in range(6)]
    frames.insert(3, replace(frames[3], seq=2**62, base_seq=2**62))
    assert accepted(arrivals, frames) == [0, 1, 2, 3, 4, 5]
    assert metrics.drops == {"ahead": 1}


def test_what_another_receiver_confirmed_is_missing_here(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    frames = [frame(0, lossless=True), frame(4, base_seq=3, lossless=True)]
    frames += [frame(k, base_seq=3, lossless=True) for k in (3, 4)]
    assert accepted(arrivals, frames) == [0, 3, 4]
    assert metrics.drops == {"missing": 2, "gap": 1}


@pytest.mark.parametrize("epoch", [5, MAX_COUNT])
def test_an_epoch_that_nobody_announced_does_not_interrupt_a_stream(metrics, epoch):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    for k in range(10):
        assert arrivals.accept(frame(k, epoch=3), k * 100 * MS)
        assert arrivals.waits_for_camera(frame(k, epoch=epoch), k * 100 * MS + 1)
        assert not arrivals.accept(frame(k, epoch=epoch), k * 100 * MS + 1, is_announced=False)
    assert arrivals.accept(frame(10, epoch=3), 5000 * MS)
    assert arrivals.accept(frame(0, epoch=epoch), 9000 * MS, is_announced=False), (
        "after a silence it is taken"
    )
    assert arrivals.accept(frame(11, epoch=3), 9001 * MS), "one with a camera is preferred"
    assert metrics.drops == {"epoch": 10}


def test_an_epoch_whose_camera_is_learned_later_is_kept(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert arrivals.accept(frame(0, epoch=5), 0, is_announced=False)
    arrivals.announced(5)
    assert not arrivals.accept(frame(0, epoch=4), 2)
    assert not arrivals.accept(frame(0, epoch=6), 2, is_announced=False)
    assert arrivals.accept(frame(0, epoch=6), 3)


@pytest.mark.parametrize("lossless", [False, True])
def test_one_frame_id_out_of_nowhere_is_left_out_and_told(metrics, lossless):
    told = []
    arrivals = Arrivals(lossless=lossless, drop=metrics.drop, tell=told.append)
    frames = [frame(k, lossless=lossless) for k in range(5)]
    frames.insert(2, replace(frames[2], frame_id=2**62))
    assert accepted(arrivals, frames) == [0, 1, 2, 3, 4]
    assert metrics.drops == {"ahead": 1}
    assert told == [f"frame {2**62} is left out: it can't follow frame 1"]


def test_a_frame_that_is_left_out_for_its_id_does_not_count_as_missing_too(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    frames = [frame(k) for k in range(5)]
    frames[2] = replace(frames[2], frame_id=2**62)
    assert accepted(arrivals, [*frames, frame(2)]) == [0, 1, 3, 4]
    assert metrics.drops == {"ahead": 1, "duplicate": 1}


@pytest.mark.parametrize("lossless", [False, True])
def test_a_stream_whose_frame_ids_went_far_on_is_taken_up_after_a_while(metrics, lossless):
    for num_before, after_s in ((1, 0.2), (2, 3.1)):  # a single one may itself be what is wrong
        arrivals = Arrivals(lossless=lossless, drop=metrics.drop)
        assert (
            len(accepted(arrivals, [frame(k, lossless=lossless) for k in range(num_before)], 0)) == num_before
        )
        far = 10**7
        taken_s = []
        for k in range(50):
            later = frame(num_before + (0 if lossless else k), lossless=lossless)
            if arrivals.accept(replace(later, frame_id=far + 1), k * 100 * MS):
                taken_s.append(k * 0.1)
                break
        assert taken_s == [pytest.approx(after_s)]
    assert metrics.drops["ahead"] == 2 + 31


def test_frame_ids_go_in_steps_of_the_source_and_on_during_a_break(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    ids = [0, 5000, 10_000, 1_000_000]
    times_ns = [0, 100 * MS, 200 * MS, 60_000 * MS]
    for k, (frame_id, t_ns) in enumerate(zip(ids, times_ns, strict=True)):
        assert arrivals.accept(replace(frame(k), frame_id=frame_id), t_ns, frame_step=5000)
    assert metrics.drops == {}


def test_after_a_long_break_of_the_link_the_numbering_goes_on(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert arrivals.accept(frame(0), 0)
    assert arrivals.accept(frame(5000), 60_000 * MS)
    assert not arrivals.accept(frame(4000), 64_000 * MS), "late, and alone"
    assert arrivals.accept(frame(5001), 64_001 * MS)
    assert metrics.drops == {"missing": 4998, "stale": 1}


def test_a_frame_that_comes_again_long_after_is_not_taken_for_a_missing_one(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    accepted(arrivals, [frame(k) for k in (5, 6, 8, 7, *range(9, 9 + 255))])
    assert metrics.drops["missing"] == 0, "7 came late"
    accepted(arrivals, [frame(8), frame(8)])
    assert metrics.drops["missing"] == 0
    assert unpack(pack(metrics.status(1)), StatusMessage).drops["stale"] == 2


@pytest.mark.parametrize("lossless", [False, True])
def test_a_restarted_agent_is_followed_and_its_former_frames_are_refused(metrics, lossless):
    arrivals = Arrivals(lossless=lossless, drop=metrics.drop)
    frames = [frame(0, 1), frame(1, 1), frame(0, 2), frame(2, 1), frame(1, 2)]
    taken = [(f.agent_epoch, f.seq) for f in frames if arrivals.accept(replace(f, lossless=lossless), 1)]
    assert taken == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert metrics.drops == {"epoch": 1}


def test_an_agent_whose_clock_went_back_is_followed_after_a_silence(metrics):
    arrivals = Arrivals(lossless=False, drop=metrics.drop)
    assert arrivals.accept(frame(0, epoch=100), 0)
    assert not arrivals.accept(frame(0, epoch=50), 1000 * MS)
    assert arrivals.accept(frame(1, epoch=50), 5000 * MS)
    assert arrivals.epoch == 50


def test_lossless_takes_each_frame_once_and_in_order(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    order = [0, 1, 3, 4, 2, 2, 3, 4, 1]
    assert accepted(arrivals, [frame(k, lossless=True) for k in order]) == [0, 1, 2, 3, 4]
    assert metrics.drops == {"gap": 2, "duplicate": 2}
    assert (arrivals.arrived_seq, arrivals.next_seq) == (5, 0)
    arrivals.done(frame(0))
    arrivals.done(frame(1))
    assert arrivals.next_seq == 2


def test_a_frame_that_is_refused_confirms_none_before_it(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    frames = [frame(k, lossless=True) for k in range(4)]
    assert accepted(arrivals, frames) == [0, 1, 2, 3]
    confirmed = []
    for k in (1, 3, 0, 2):
        arrivals.done(frames[k])
        confirmed.append(arrivals.next_seq)
    assert confirmed == [0, 0, 2, 4]


@pytest.mark.parametrize("lossless", [False, True])
def test_a_frame_that_never_comes_to_the_consumer_holds_nothing_up_for_ever(metrics, lossless):
    arrivals = Arrivals(lossless=lossless, drop=metrics.drop)
    arrivals.accept(frame(0, lossless=lossless), 0)
    for k in range(1, 1000):
        arrivals.accept(frame(k, lossless=lossless), 0)
        arrivals.done(frame(k))
    assert arrivals.next_seq == 1000
    assert not arrivals._done_early


def test_a_lossless_receiver_joins_at_the_first_unconfirmed_frame(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    # 7 was lost on its way to the new receiver: 8 must not be taken before it.
    order = [frame(8, base_seq=7, lossless=True), frame(7, base_seq=7, lossless=True)]
    assert accepted(arrivals, order) == [7]
    assert metrics.drops == {"gap": 1}


def test_a_frame_that_was_long_on_its_way_does_not_hold_a_new_receiver_up(metrics):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    # Sent before the former receiver confirmed 6 and 7, which the sender has forgotten since.
    assert accepted(arrivals, [frame(8, base_seq=6, lossless=True)]) == []
    assert accepted(arrivals, [frame(k, base_seq=8, lossless=True) for k in (8, 9, 8)]) == [8, 9]
    assert (arrivals.next_seq, arrivals.arrived_seq) == (8, 10)
    assert metrics.drops == {"gap": 1, "duplicate": 1}


@pytest.mark.parametrize("seq", [MAX_COUNT - 1, MAX_COUNT])
def test_how_far_a_receiver_is_can_be_told_whatever_number_it_takes(metrics, seq):
    arrivals = Arrivals(lossless=True, drop=metrics.drop)
    sent = replace(frame(0, lossless=True), seq=seq, base_seq=seq)
    values = {field.name: getattr(sent, field.name) for field in fields(sent)}
    try:
        message = unpack(msgpack.packb(values), SymbolFrame)
    except WireError:
        return
    assert arrivals.accept(message, 1)
    arrivals.done(message)
    flow = FlowMessage(agent_epoch=1, next_seq=arrivals.next_seq, arrived_seq=arrivals.arrived_seq, window=6)
    assert unpack(pack(flow), FlowMessage) == flow


def test_age_needs_no_common_clock():
    age = CaptureAge()
    offset_ns = 123456789 * MS
    for k in range(10):
        way_ms = 5 if k != 4 else 2
        age.arrived(k * 100 * MS, k * 100 * MS + offset_ns + way_ms * MS)
    now_ns = 900 * MS + offset_ns + 30 * MS
    assert age.age_ms(900 * MS, now_ns) == pytest.approx(28.0)
    assert CaptureAge().age_ms(0, 5) == 0.0


def test_frames_of_an_agent_that_slept_are_no_older_than_before():
    age = CaptureAge()  # the agent's clock stood still while it was suspended, the server's did not
    for k in range(100):
        age.arrived(k * 100 * MS, k * 100 * MS)
    for k in range(100, 200):
        age.arrived(k * 100 * MS, k * 100 * MS + 60_000 * MS)
        assert age.age_ms(k * 100 * MS, k * 100 * MS + 60_005 * MS) == pytest.approx(5.0)


def test_age_adapts_to_a_link_that_became_slower():
    age = CaptureAge()
    for k in range(400):
        way_ms = 2 if k < 100 else 700
        age.arrived(k * 100 * MS, k * 100 * MS + way_ms * MS)
    assert age.age_ms(40_000 * MS, 40_700 * MS) == pytest.approx(0.0)


def test_one_frame_from_the_future_makes_no_other_too_old():
    age = CaptureAge()
    for k in range(300):
        lead_ms = 3_600_000 if k in (50, 120) else 0
        age.arrived((k * 100 + lead_ms) * MS, (k * 100 + 5) * MS)
        assert age.age_ms(k * 100 * MS, (k * 100 + 15) * MS) == pytest.approx(10.0)


def test_a_first_frame_from_the_future_makes_three_others_too_old_and_no_more():
    age = CaptureAge()
    age.arrived(3_600_000 * MS, 0)
    for k in range(1, 50):
        age.arrived(k * 100 * MS, (k * 100 + 5) * MS)
        is_old = age.age_ms(k * 100 * MS, (k * 100 + 15) * MS) > 1000.0
        assert is_old == (k < 3)


def test_a_way_that_became_much_shorter_is_believed_after_some_frames():
    age = CaptureAge()
    for k in range(20):
        way_ms = 4000 if k < 10 else 5
        age.arrived(k * 100 * MS, (k * 100 + way_ms) * MS)
    assert age.age_ms(2000 * MS, 2025 * MS) == pytest.approx(20.0)
