"""One start of an agent, frame by frame, without a network."""

import contextlib
import json
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_markers import draw_marker
from rows_of_runs import frame_row

from semcast.common.camera import Intrinsics
from semcast.common.config import build_settings, read_toml
from semcast.common.geometry import invert_transform, make_transform
from semcast.common.image_file import read_image
from semcast.common.run_folder import FRAMES_NAME, read_image_paths, read_run
from semcast.common.sequence import open_sequence
from semcast.server.decoder import Arrival
from semcast.server.frame_rows import FrameRows, read_rows
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame
from semcast.server.marker_settings import MarkerSettings
from semcast.server.reference import Reference
from semcast.server.replay import ReplaySettings
from semcast.server.session import Session
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity

CAMERA = Intrinsics(fx=60, fy=60, cx=47.5, cy=31.5, width=96, height=64)
IDENTITY = StreamIdentity(agent_id="a", agent_epoch=5, codec="x", digest="", camera=CAMERA, num_frames=None)
IMAGE = np.full((64, 96, 3), 99, np.uint8)
DEMO = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"


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


def test_rows_that_are_not_in_their_file_at_the_end_are_an_error_and_cost_no_other_file(tmp_path):
    told = []
    settings = ServerSettings(bundle="inline")
    session = Session(settings, IDENTITY, tmp_path / "run", None, on_error=told.append)
    with contextlib.closing(session):
        session._record._file.close()
        session._record._file = None
        (tmp_path / "run").rename(tmp_path / "elsewhere")
        now_ns = time.perf_counter_ns()
        session.process(DecodedFrame(0, 0, IMAGE, None), Arrival(None, None, now_ns, now_ns, {}, {}))
        with pytest.raises(OSError, match=r"frames\.jsonl: No such file or directory"):
            session.write_outputs(tmp_path / "elsewhere", {}, complete=True)
    (text,) = told
    assert text.startswith(f"{tmp_path / 'run' / FRAMES_NAME} can't be written: [Errno 2] No such file")
    assert json.loads((tmp_path / "elsewhere" / "summary.json").read_text())["frames"]["tracked"] == 1


def test_in_replay_every_frame_waits_for_its_psnr(process):
    one = process(Reference(lambda frame_id: IMAGE), mode="replay")
    assert [one(k) for k in range(3)] == [100.0] * 3


@pytest.fixture(scope="module")
def demo():
    return open_sequence(DEMO, resize=0.35)


def run_session(demo, folder, frame_ids, epoch=5, program=None, **settings):
    """A session over some frames of the demo; ends with its outputs unless it is ``killed``.

    Depth, which takes longer than all else, is left out unless ``settings`` want it.
    """
    killed = settings.pop("killed", False)
    picture = settings.pop("picture", lambda demo, k: demo.image(k))
    identity = StreamIdentity(
        agent_id="a", agent_epoch=epoch, codec="x", digest="", camera=demo.intrinsics, num_frames=None
    )
    session = Session(
        ServerSettings(bundle="inline", out=folder, **{"dense_cloud": "none", **settings}),
        identity,
        folder,
        None,
        program=program,
    )
    for k in frame_ids:
        now_ns = time.perf_counter_ns()
        frame = DecodedFrame(k, int(demo.times_ns[k]), picture(demo, k), None)
        session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
    try:
        if killed:
            session.save_checkpoint()
        else:
            session.conclude()
            list(session.complete_cloud())
            session.write_outputs(folder, {}, complete=True)
    finally:
        session.close()
    return session


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

    def fails(self, *, wait=False):
        self._bundle.take(wait=wait)
        raise np.linalg.LinAlgError("singular")

    with contextlib.closing(session):
        for k in range(8):
            now_ns = time.perf_counter_ns()
            frame = DecodedFrame(k, int(demo.times_ns[k]), demo.image(k), None)
            outcome = session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
            with monkeypatch.context() as patch:
                patch.setattr("semcast.server.mapping.map_builder.MapBuilder.collect", fails)
                session.use_time()
            assert not session.is_adjusting
    assert outcome.result.T_world_cam is not None
    assert set(told) == {"an adjustment could not be applied: singular"}
    assert "could not be applied and is left out" in caplog.text


@pytest.mark.parametrize(("final", "source"), [(True, 4), (False, 98)])
def test_a_source_had_as_many_frames_as_came_until_its_last(demo, caplog, final, source):
    identity = replace(IDENTITY, camera=demo.intrinsics, num_frames=98, last_frame_id=97)
    with contextlib.closing(Session(ServerSettings(bundle="inline"), identity, None, None)) as session:
        for k in range(4):
            session.note_arrival(k, k, final=final and k == 3)
        summary = session.write_outputs(None, {}, complete=True)
        session.write_outputs(None, {}, complete=True)
        assert caplog.text.count("0 frames tracked") == 1, "the same line says nothing new"
        broken_off = session.write_outputs(None, {}, complete=False)
    assert (summary["frames"]["source"], summary["frames"]["sent"]) == (source, 4)
    assert broken_off["frames"]["source"] == 4, "of one that was broken off, what came"
    assert summary["versions"]["semcast"]


@pytest.mark.parametrize("num_superseded", [2, 3])
def test_a_server_without_time_for_most_frames_says_so_once_and_what_leaves_it_more(caplog, num_superseded):
    with contextlib.closing(Session(ServerSettings(bundle="inline"), IDENTITY, None, None)) as session:
        for k in range(4):
            session.note_arrival(k, k, final=k == 3)
        for _ in range(2):
            session.write_outputs(None, {"superseded": num_superseded}, complete=True)
    told = [text for text in caplog.messages if text.startswith("the server had no time")]
    assert len(told) == (num_superseded > 2)
    if told:
        assert "had no time for 3 of 4; a smaller --resize, a larger --stride" in told[0]


@pytest.mark.parametrize(("interval_s", "saved"), [(3600.0, 0), (0.1, 1)])
def test_the_map_is_kept_as_often_as_is_said(process, monkeypatch, interval_s, saved):
    seen = []
    monkeypatch.setattr(Session, "save_checkpoint", lambda session: seen.append(session))
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


def test_frames_that_the_agent_left_out_don_t_count_as_unposed(demo, tmp_path):
    identity = StreamIdentity(
        agent_id="a", agent_epoch=5, codec="x", digest="", camera=demo.intrinsics, num_frames=51
    )
    session = Session(ServerSettings(bundle="inline", out=tmp_path), identity, tmp_path, None)
    sent = [*range(8), *range(8, 20, 2), *range(20, 30, 3)]  # one in two, then one in three
    for seq, k in enumerate(sent):
        if k == 14:
            continue  # never arrived
        session.note_arrival(k, seq)
        if k == sent[-1]:
            continue  # can't be decoded
        now_ns = time.perf_counter_ns()
        frame = DecodedFrame(k, int(demo.times_ns[k]), demo.image(k), None)
        session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
    summary = session.write_outputs(tmp_path, {}, complete=True)
    session.close()
    assert summary["frames"] == {**summary["frames"], "source": 51, "sent": len(sent), "posed": len(sent) - 2}
    assert summary["completeness"] == (len(sent) - 2) / len(sent)
    assert summary["unposed_frames"] == [(14, 14), (29, 29)]
    assert [row.seq for row in read_rows(tmp_path / FRAMES_NAME)] == [k for k in range(17) if k != 11]


@pytest.fixture(scope="module")
def twelve_frames(demo, tmp_path_factory):
    """What a session leaves of them."""
    folder = tmp_path_factory.mktemp("twelve") / "run"
    run_session(demo, folder, range(12), save_images="keyframes")
    return folder


def test_every_keyframe_has_its_image_also_those_the_map_began_with(twelve_frames):
    keyframes = read_run(twelve_frames).keyframe_ids.tolist()
    assert keyframes[0] == 0
    assert list(read_image_paths(twelve_frames)) == keyframes


def test_all_images_are_kept_where_all_are_wanted(demo, tmp_path):
    run_session(demo, tmp_path, range(8), save_images="all")
    assert list(read_image_paths(tmp_path)) == list(range(8))


@pytest.mark.parametrize("readout_ms", [0.0, 60.0])
def test_images_are_kept_as_poses_and_observations_fit_them(demo, tmp_path, readout_ms):
    reconstruction = ReconstructionSettings(readout_ms=readout_ms)
    session = run_session(demo, tmp_path, range(8), save_images="all", reconstruction=reconstruction)
    kept = read_image(read_image_paths(tmp_path)[7]).astype(float)
    received = demo.image(7)
    put_right = session._reconstruction.put_right(received)
    assert np.abs(kept - put_right).mean() < 3, "JPEG"
    assert (np.abs(kept - received).mean() < 3) == (readout_ms == 0.0)


def mirrored_later(demo, k):
    """The demo, and from its eighth frame on another place: its mirror image."""
    image = demo.image(k)
    return image if k < 8 else np.ascontiguousarray(image[:, ::-1])


@pytest.fixture(scope="module")
def two_parts(demo, tmp_path_factory):
    """What a session leaves of two places that never met."""
    folder = tmp_path_factory.mktemp("parts") / "run"
    how = ReconstructionSettings(lost_after_s=0.25)
    run_session(demo, folder, range(20), picture=mirrored_later, save_images="keyframes", reconstruction=how)
    return folder


def test_every_keyframe_of_a_later_part_has_its_image_too(two_parts):
    keyframes = read_run(two_parts).keyframe_ids.tolist()
    assert min(k for k in keyframes if k >= 8) < 12, "the part began with frames that were lost"
    assert list(read_image_paths(two_parts)) == keyframes


def test_parts_that_never_met_are_told_apart_in_all_that_is_left(two_parts):
    data = read_run(two_parts)
    first = data.frame_ids < 8
    assert data.frame_submap.tolist() == [0 if early else 1 for early in first]
    for part in (0, 1):
        seen = np.isin(data.observed_keyframe_ids, data.frame_ids[data.frame_submap == part])
        marks = np.isin(data.landmark_ids, data.observed_landmark_ids[seen])
        assert marks.any()
        assert set(data.landmark_submap[marks].tolist()) == {part}
    summary = json.loads((two_parts / "summary.json").read_text())
    num_first, num_later = int(first.sum()), int((~first).sum())
    assert min(num_first, num_later) > 3
    assert summary["parts"] == [
        {"submap": 0, "num_posed": num_first},
        {"submap": 1, "num_posed": num_later},
    ]
    rows = read_rows(two_parts / FRAMES_NAME)
    assert (rows[0].submap, rows[-1].submap) == (0, 1)
    early = [row.frame_id for row in rows if row.submap == 0 and row.frame_id >= 8]
    assert set(early) & set(data.frame_ids.tolist()), "a start gave frames a pose that had been lost"


def test_the_summary_counts_the_keyframes_of_the_map_also_those_it_began_with(twelve_frames):
    num_keyframes = len(read_run(twelve_frames).keyframe_ids)
    assert num_keyframes > sum(row.is_keyframe for row in read_rows(twelve_frames / FRAMES_NAME))
    assert json.loads((twelve_frames / "summary.json").read_text())["frames"]["keyframes"] == num_keyframes


def test_the_dense_cloud_lies_around_the_landmarks_where_it_is_wanted(demo, tmp_path, read_ply):
    run_session(demo, tmp_path / "dense", range(14), mode="replay", dense_cloud="auto")
    run_session(demo, tmp_path / "sparse", range(14), mode="replay", dense_cloud="none")
    assert not (tmp_path / "sparse" / "dense.ply").exists()
    assert json.loads((tmp_path / "sparse" / "summary.json").read_text())["num_dense_points"] is None
    cloud, marks = (read_ply(tmp_path / "dense" / name) for name in ("dense.ply", "map.ply"))
    assert len(cloud) == json.loads((tmp_path / "dense" / "summary.json").read_text())["num_dense_points"]
    assert len(cloud) > 4 * len(marks)
    for axis in "xyz":
        low, high = np.percentile(marks[axis], (2, 98))
        beyond = 0.5 * (high - low)
        assert ((cloud[axis] > low - beyond) & (cloud[axis] < high + beyond)).mean() > 0.9
    alike = [(tmp_path / name / "trajectory.tum").read_bytes() for name in ("dense", "sparse")]
    assert alike[0] == alike[1], "no pose depends on it"


def test_a_cloud_that_fails_ends_alone(demo, tmp_path, monkeypatch, caplog):
    def broken(*_):
        raise RuntimeError("no depth today")

    monkeypatch.setattr("semcast.server.dense.builder.DenseBuilder.add_keyframe", broken)
    run_session(demo, tmp_path, range(6), dense_cloud="auto")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"]["posed"] == 6
    assert summary["num_dense_points"] is None
    assert caplog.text.count("the dense cloud no longer grows") == 1


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


def test_a_file_that_can_not_be_written_costs_no_other(demo, tmp_path, read_ply):
    for name in ("trajectory.tum", "summary.json"):
        (tmp_path / name).mkdir()
    message = "^trajectory.tum: Is a directory; summary.json: Is a directory$"
    with pytest.raises(OSError, match=message):
        run_session(demo, tmp_path, range(8))
    assert len(read_run(tmp_path).frame_ids) >= 5
    assert len(read_ply(tmp_path / "map.ply")) > 20
    assert read_toml(tmp_path / "settings.toml")


def test_results_have_the_map_as_it_was_adjusted_at_the_end_where_that_is_wanted(demo, tmp_path):
    runs = {}
    for wanted in (True, False):
        how = ReconstructionSettings(final_adjustment=wanted)
        run_session(demo, tmp_path / str(wanted), range(14), reconstruction=how)
        runs[wanted] = read_run(tmp_path / str(wanted))
    assert np.array_equal(runs[True].frame_ids, runs[False].frame_ids)
    moved_m = np.linalg.norm((runs[True].T_world_cam - runs[False].T_world_cam)[:, :3, 3], axis=1)
    way_m = np.linalg.norm(np.ptp(runs[False].T_world_cam[:, :3, 3], axis=0))
    assert 1e-5 < moved_m.max() / way_m < 0.05


def test_results_are_written_where_the_adjustment_at_the_end_fails(demo, tmp_path, monkeypatch, caplog):
    def fail(*_):
        raise RuntimeError("out of memory")

    monkeypatch.setattr("semcast.server.mapping.map_builder.adjust_whole_map", fail)
    run_session(demo, tmp_path, range(12))
    assert "could not be adjusted as a whole" in caplog.text
    assert len(read_run(tmp_path).frame_ids) >= 8


def test_the_records_hold_the_settings_of_the_program(demo, tmp_path):
    program = ReplaySettings(file=Path("run.mcap"), pace=2.0)
    run_session(demo, tmp_path, range(3), program=program)
    assert build_settings(ReplaySettings, read_toml(tmp_path / "settings.toml")) == program
    assert json.loads((tmp_path / "summary.json").read_text())["settings"]["pace"] == 2.0
