"""Which camera frames are of, and agents that were started again."""

from receiver_ends import EPOCH, camera
from waiting import until

from semcast.common.keys import camera_key
from semcast.common.wire import pack


def test_a_late_receiver_learns_the_camera_by_asking(ends, make_frame):
    e = ends()
    e.put(make_frame(0))
    until(lambda: e.metrics.counts.get("received") == 1)
    assert e.receiver.next(0.0) is None, "nobody answers yet"
    assert e.metrics.drops == {"camera": 1}
    e.answer_camera(camera())
    until(lambda: e.hub.request(camera_key("a"), b"", 0.5) is not None)
    e.put(make_frame(1))
    assert e.receiver.next(60).camera == camera()


def test_no_frame_is_delivered_twice_and_a_new_agent_is_followed(ends, make_frame):
    e = ends()
    publisher = e.client.publisher(camera_key("a"), "every")
    until(lambda: publisher.has_receiver)
    for epoch in (EPOCH, EPOCH + 1):
        publisher.put(pack(camera(epoch)))
    until(lambda: len(e.receiver._cameras) == 2)
    seen = []
    script = [(0, 0), (1, 0), (1, 0), (0, 0), (4, 0), (3, 0), (0, 1), (5, 0), (1, 1)]
    for count, (seq, epoch) in enumerate(script, start=1):
        e.put(make_frame(seq, epoch=EPOCH + epoch))
        until(lambda count=count: e.metrics.counts.get("received") == count)
        frame = e.receiver.next(0.0)
        if frame is not None:
            seen.append((frame.message.seq, frame.message.agent_epoch - EPOCH))
    assert seen == [(0, 0), (1, 0), (4, 0), (0, 1), (1, 1)]
    assert e.metrics.drops == {"duplicate": 2, "missing": 1, "stale": 1, "epoch": 1}


def test_the_camera_of_an_agent_whose_clock_went_back_is_kept_beside_many_later_ones(ends, make_frame):
    e = ends()
    publisher = e.client.publisher(camera_key("a"), "every")
    until(lambda: publisher.has_receiver)
    for epoch in (*range(EPOCH + 1, EPOCH + 41), EPOCH):
        publisher.put(pack(camera(epoch)))
    until(lambda: EPOCH in e.receiver._cameras)
    e.put(make_frame(0))
    assert e.receiver.next(60).camera == camera(EPOCH)
    assert len(e.receiver._cameras) <= 16


def test_replay_keeps_a_frame_until_the_camera_is_known(ends, make_frame):
    e = ends("replay")
    e.put(make_frame(0, lossless=True))
    assert e.receiver.next(0.05) is None
    e.answer_camera(camera(lossless=True))
    assert e.receiver.next(60).message.seq == 0
    assert e.metrics.drops == {}


def test_a_camera_that_nobody_knows_is_asked_for_a_few_times_a_second(ends, make_frame, monkeypatch):
    e = ends("replay")
    asked = []
    monkeypatch.setattr(e.hub, "request", lambda key, *rest: asked.append(key))
    e.put(make_frame(0, lossless=True))
    until(lambda: e.metrics.counts.get("received") == 1)
    assert e.receiver.next(0.2) is None
    assert set(asked) == {camera_key("a")}
    assert len(asked) <= 6


def test_replay_drops_a_frame_whose_agent_was_restarted_before_its_camera_was_known(ends, make_frame):
    e = ends("replay")
    e.put(make_frame(0, lossless=True), make_frame(1, lossless=True))
    until(lambda: e.metrics.counts.get("received") == 2)
    assert e.receiver.next(0.05) is None
    e.answer_camera(camera(EPOCH + 1, lossless=True))
    e.put(make_frame(0, epoch=EPOCH + 1, lossless=True))
    assert e.receiver.next(60).message.agent_epoch == EPOCH + 1
    assert e.metrics.drops == {"epoch": 2}


def test_none_of_an_ended_stream_is_missing_once_frames_of_the_agents_next_start_are_there(ends, make_frame):
    e = ends()
    e.put(*(make_frame(k) for k in range(5)), make_frame(0, epoch=EPOCH + 1))
    until(lambda: e.metrics.counts.get("received") == 6)
    e.receiver.count_missing(EPOCH, 5)
    assert "missing" not in e.metrics.drops


def test_a_frame_that_overtakes_the_camera_of_a_new_start_waits_for_it(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    e.put(make_frame(0))
    assert e.receiver.next(60).message.seq == 0
    e.put(make_frame(0, epoch=EPOCH + 1))
    until(lambda: len(e.receiver._early) == 1)
    assert e.receiver.agent_epoch == EPOCH
    e.receiver._on_camera(pack(camera(EPOCH + 1)))
    assert e.receiver.next(60).message.agent_epoch == EPOCH + 1
    e.receiver._on_camera(pack(camera(EPOCH + 1)))
    assert e.metrics.drops == {}, "it waited once, and does not come again"


def test_starts_that_nobody_announced_do_not_interrupt_a_stream(ends, make_frame):
    e = ends()
    e.answer_camera(camera())
    for k in range(30):
        e.put(make_frame(k))
        assert e.receiver.next(60).message.seq == k
        e.put(make_frame(0, epoch=2**62 + k))
    until(lambda: e.metrics.counts.get("received") == 60 or e.metrics.drops.get("camera") == 14)
    assert e.metrics.drops == {"camera": 14}
    assert len(e.receiver._early) == 16
    assert "does not say what its camera is" in e.metrics.status(0).last_error
