"""What a session leaves behind: rows, images, results and their summary."""

import contextlib
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demo_session import open_demo, run_session

from semcast.common.camera import Intrinsics
from semcast.common.config import build_settings, read_toml
from semcast.common.image_file import read_image
from semcast.common.run_folder import FRAMES_NAME, read_image_paths, read_run
from semcast.server.decoder import Arrival
from semcast.server.frame_rows import read_rows
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame
from semcast.server.replay import ReplaySettings
from semcast.server.session import Session
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity

CAMERA = Intrinsics(fx=60, fy=60, cx=47.5, cy=31.5, width=96, height=64)
IDENTITY = StreamIdentity(agent_id="a", agent_epoch=5, codec="x", digest="", camera=CAMERA, num_frames=None)
IMAGE = np.full((64, 96, 3), 99, np.uint8)


@pytest.fixture(scope="module")
def demo():
    return open_demo()


def test_rows_that_are_not_in_their_file_at_the_end_are_an_error_and_cost_no_other_file(tmp_path):
    told = []
    settings = ServerSettings(bundle="inline")
    session = Session(settings, IDENTITY, tmp_path / "run", None, on_error=told.append)
    with contextlib.closing(session):
        session._records.rows._file.close()
        session._records.rows._file = None
        (tmp_path / "run").rename(tmp_path / "elsewhere")
        now_ns = time.perf_counter_ns()
        session.process(DecodedFrame(0, 0, IMAGE, None), Arrival(None, None, now_ns, now_ns, {}, {}))
        with pytest.raises(OSError, match=r"frames\.jsonl: No such file or directory"):
            session.write_outputs(tmp_path / "elsewhere", {}, complete=True)
    (text,) = told
    assert text.startswith(f"{tmp_path / 'run' / FRAMES_NAME} can't be written: [Errno 2] No such file")
    assert json.loads((tmp_path / "elsewhere" / "summary.json").read_text())["frames"]["tracked"] == 1


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

    monkeypatch.setattr("semcast.server.mapping.adjuster.adjust_whole_map", fail)
    run_session(demo, tmp_path, range(12))
    assert "could not be adjusted as a whole" in caplog.text
    assert len(read_run(tmp_path).frame_ids) >= 8


def test_the_records_hold_the_settings_of_the_program(demo, tmp_path):
    program = ReplaySettings(file=Path("run.mcap"), pace=2.0)
    run_session(demo, tmp_path, range(3), program=program)
    assert build_settings(ReplaySettings, read_toml(tmp_path / "settings.toml")) == program
    assert json.loads((tmp_path / "summary.json").read_text())["settings"]["pace"] == 2.0
