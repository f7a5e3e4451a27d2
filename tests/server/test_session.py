"""One start of an agent, frame by frame, without a network."""

import contextlib
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from demo_session import open_demo, run_session
from drawn_markers import draw_marker
from rows_of_runs import frame_row

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform
from semcast.common.run_folder import FRAMES_NAME, read_image_paths
from semcast.server.decoder import Arrival
from semcast.server.frame_rows import FrameRows, read_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.marker_settings import MarkerSettings
from semcast.server.reference import Reference
from semcast.server.session import Session
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity

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
    wait_s = 0.5
    monkeypatch.setattr("semcast.server.session.LIVE_PSNR_WAIT_S", wait_s)
    asked, readable = [], threading.Event()

    def original(frame_id):
        asked.append(frame_id)
        readable.wait(60)
        return IMAGE

    one = process(Reference(original))
    started_s = time.monotonic()
    assert [one(k) for k in range(40)] == [None] * 40
    assert time.monotonic() - started_s < 30 * wait_s, "one frame waited, not forty"
    readable.set()
    end_s = time.monotonic() + 60
    last = 40
    while (psnr_db := one(last)) is None:
        assert time.monotonic() < end_s
        last += 1
    assert psnr_db == 100.0
    assert asked == [0, last]


def test_in_replay_every_frame_waits_for_its_psnr(process):
    one = process(Reference(lambda frame_id: IMAGE), mode="replay")
    assert [one(k) for k in range(3)] == [100.0] * 3


@pytest.fixture(scope="module")
def demo():
    return open_demo()


def test_every_frame_tells_once_what_became_of_it(demo, tmp_path):
    identity = StreamIdentity(
        agent_id="a", agent_epoch=5, codec="x", digest="", camera=demo.intrinsics, num_frames=None
    )
    session = Session(ServerSettings(bundle="inline", out=tmp_path), identity, tmp_path, None)
    told, outcomes, told_ms = [], [], []
    for k in range(8):
        now_ns = time.perf_counter_ns()
        frame = DecodedFrame(k, int(demo.times_ns[k]), demo.image(k), None)

        def tell(found, since_ns=now_ns):
            told.append(found)
            told_ms.append((time.perf_counter_ns() - since_ns) * 1e-6)

        outcomes.append(session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}), tell))
    session.close()
    rows = read_rows(tmp_path / FRAMES_NAME)
    assert [found.frame_id for found in told] == list(range(8))
    assert [f.backfilled for f in told] == [o.result.backfilled for o in outcomes]
    assert told[0].T_world_cam is None
    assert told[-1].T_world_cam is not None
    for row, ms in zip(rows, told_ms, strict=True):
        assert 0 < row.stage_ms["decoded_to_pose"] <= ms


@pytest.mark.parametrize(("mode", "uses_it"), [("live", True), ("replay", False)])
def test_time_between_two_live_frames_is_used_for_what_the_next_one_would_wait_for(
    demo, tmp_path, mode, uses_it
):
    identity = StreamIdentity(
        agent_id="a", agent_epoch=5, codec="x", digest="", camera=demo.intrinsics, num_frames=None
    )
    settings = ServerSettings(bundle="inline", out=tmp_path, dense_cloud="none", mode=mode)
    session = Session(settings, identity, tmp_path, None)
    adjusted = []
    for k in range(8):
        now_ns = time.perf_counter_ns()
        frame = DecodedFrame(k, int(demo.times_ns[k]), demo.image(k), None)
        session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
        adjusted.append(session.is_adjusting)
        session.use_time()
        assert not session.is_adjusting
    session.close()
    assert any(adjusted) == uses_it
    rows = read_rows(tmp_path / FRAMES_NAME)
    assert any("apply" in row.stage_ms for row in rows), "it is applied in either mode"


def test_an_adjustment_that_can_not_be_applied_between_two_frames_does_not_end_the_stream(
    demo, tmp_path, monkeypatch, caplog
):
    told = []
    identity = replace(IDENTITY, camera=demo.intrinsics)
    settings = ServerSettings(bundle="inline", out=tmp_path, dense_cloud="none")
    session = Session(settings, identity, tmp_path, None, on_error=told.append)

    def fails(self, world, *, wait=False):
        self._bundle.take(wait=wait)
        raise np.linalg.LinAlgError("singular")

    with contextlib.closing(session):
        for k in range(8):
            now_ns = time.perf_counter_ns()
            frame = DecodedFrame(k, int(demo.times_ns[k]), demo.image(k), None)
            outcome = session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
            with monkeypatch.context() as patch:
                patch.setattr("semcast.server.mapping.adjuster.Adjuster.collect", fails)
                session.use_time()
            assert not session.is_adjusting
    assert outcome.result.T_world_cam is not None
    assert set(told) == {"an adjustment could not be applied: singular"}
    assert "could not be applied and is left out" in caplog.text


@pytest.mark.parametrize(("interval_s", "saved"), [(3600.0, 0), (0.1, 1)])
def test_the_map_is_kept_as_often_as_is_said(process, monkeypatch, interval_s, saved):
    seen = []
    monkeypatch.setattr(Session, "save_checkpoint", lambda session, drops: seen.append(session))
    one = process(Reference(lambda frame_id: IMAGE), checkpoint_interval_s=interval_s)
    threading.Event().wait(0.11)
    one(0)
    assert len(seen) == saved


def test_where_a_map_begins_and_the_camera_is_lost_is_said_once(demo, tmp_path, caplog):
    caplog.set_level("INFO", logger="semcast.server.session")
    noise = np.random.default_rng(0).integers(0, 255, demo.image(0).shape, dtype=np.uint8)

    def picture(demo, k):
        return noise if k > 12 else demo.image(k) * (k not in (8, 9))

    run_session(demo, tmp_path, range(15), picture=picture)
    said = [record.message for record in caplog.records if record.message.startswith("frame ")]
    assert [text.partition(": ")[2] for text in said] == [
        "a map has begun",
        "the image shows nothing: is the lens covered?",
        "the image shows something again",
        "the camera is lost",
    ]
    assert [text.partition(":")[0] for text in said[1:]] == ["frame 8", "frame 10", "frame 13"]


def test_a_resumed_session_goes_on_with_what_is_there_and_a_new_one_sets_it_aside(demo, tmp_path):
    run_session(demo, tmp_path, range(8), save_images="keyframes", killed=True)
    before = list(read_image_paths(tmp_path))
    assert before
    resumed = run_session(demo, tmp_path, range(8, 20), save_images="keyframes")
    assert resumed.resumed
    after = list(read_image_paths(tmp_path))
    assert set(before) < set(after)
    trajectory = (tmp_path / "trajectory.tum").read_bytes()
    run_session(demo, tmp_path, range(3), epoch=6, save_images="none")
    assert not read_image_paths(tmp_path)
    assert list(read_image_paths(tmp_path / "previous-1")) == after
    assert (tmp_path / "previous-1" / "trajectory.tum").read_bytes() == trajectory


def test_a_resumed_session_knows_the_metre_until_its_map_is_reset(demo, tmp_path):
    T_world_cam = demo.groundtruth().T_world_cam
    T_world_marker = T_world_cam[0] @ make_transform(np.diag([1.0, -1.0, -1.0]), (-4.0, -0.5, 36.0))

    def with_marker(sequence, k):
        T_cam_marker = invert_transform(T_world_cam[k]) @ T_world_marker
        return draw_marker(sequence.image(k), sequence.intrinsics, T_cam_marker, 3.0, 5)

    marker = MarkerSettings(side_m=3.0)
    killed = run_session(demo, tmp_path, range(24), killed=True, marker=marker, picture=with_marker)
    before = killed.metres.summary()
    assert before[0]["marker_id"] == 5
    identity = StreamIdentity(
        agent_id="a", agent_epoch=5, codec="x", digest="", camera=demo.intrinsics, num_frames=None
    )
    session = Session(ServerSettings(bundle="inline", out=tmp_path, marker=marker), identity, tmp_path, None)
    with contextlib.closing(session):
        assert session.resumed
        assert session.metres.summary() == before
        session.restart_map()
        assert session.metres.summary() == []


def test_a_resume_shows_the_map_before_with_a_gap_where_it_was_lost_and_a_reset_nothing_of_it(demo, tmp_path):
    run_session(demo, tmp_path, [*range(8), 9], killed=True)
    with contextlib.closing(FrameRows(tmp_path, resume=True)) as rows:
        rows.add(frame_row(8, posed=False))
    shown = []
    for is_reset in (False, True):
        out = ServerSettings(bundle="inline", out=tmp_path)
        session = Session(out, replace(IDENTITY, camera=demo.intrinsics), tmp_path, None)
        assert session.resumed
        if is_reset:
            session.restart_map()
        now_ns = time.perf_counter_ns()
        frame = DecodedFrame(10, int(demo.times_ns[10]), demo.image(10), None)
        view = session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {})).view
        shown.append([(k, k in view.after_gaps) for k, *_ in view.backfilled])
        session.close()
    assert len(shown[0]) >= 6
    assert [k for k, is_after_gap in shown[0] if is_after_gap] == [9]
    assert shown[1] == []
