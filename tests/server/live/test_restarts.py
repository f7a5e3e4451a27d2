"""Agents and servers that are started again, in the middle of a stream."""

import contextlib
import json
import logging
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from semcast.common.errors import ConfigError, SemcastError
from semcast.common.recorded_streams import recorded_streams
from semcast.common.recording_reader import RecordingReader
from semcast.common.run_folder import read_run
from semcast.common.sequence import open_sequence
from semcast.common.wire import pack
from semcast.server.export.outputs import write_ply
from semcast.server.feedback import WINDOW
from semcast.server.view.rerun_viewer import RerunStream
from semcast.server.view.settings import ViewSettings
from semcast.server.viewing import SuccessiveViews

pytestmark = pytest.mark.xdist_group("real-time")

DEADLINE_S = 60.0
DEMO = Path(__file__).resolve().parents[3] / "deploy" / "demo" / "kitti_06"


def centre(pose):
    return np.array(pose.T_world_cam)[[3, 7, 11]]


def test_a_restarted_agent_begins_a_new_map_and_the_former_run_is_kept(tmp_path, air, caplog):
    caplog.set_level("INFO")
    running = air.serve(out=tmp_path)
    first = air.agent(100)
    first.stream(range(8))
    first.close()
    second = air.agent(200)
    second.stream(range(4))
    summary = running.finish(stop=True)
    assert summary["frames"]["tracked"] == 4
    former = json.loads((tmp_path / "previous-1" / "summary.json").read_text())
    assert former["frames"]["tracked"] == 8
    assert f"outputs of the stream before are in {tmp_path / 'previous-1'}" in caplog.text
    assert len((tmp_path / "previous-1" / "frames.jsonl").read_text().splitlines()) == 8
    assert len((tmp_path / "frames.jsonl").read_text().splitlines()) == 4


def test_a_server_that_keeps_running_writes_what_a_stream_leaves_when_it_ends(tmp_path, air):
    running = air.serve(out=tmp_path, keep_running=True)

    def until_tracked(number):
        deadline_s = time.monotonic() + DEADLINE_S
        while True:
            with contextlib.suppress(OSError):
                summary = json.loads((tmp_path / "summary.json").read_text())
                if summary["frames"]["tracked"] == number:
                    return summary
            assert time.monotonic() < deadline_s
            time.sleep(0.01)

    radio = air.agent(100)
    radio.stream(range(10))
    radio.stream([10], final=True)
    radio.close()
    ended = until_tracked(11)
    assert ended["num_posed"] == len(read_run(tmp_path).frame_ids) >= 8
    written = (tmp_path / "summary.json").stat().st_mtime_ns
    again = air.agent(100)
    again.stream(range(11, 13))
    assert (tmp_path / "summary.json").stat().st_mtime_ns == written, "once, and while nothing more comes"
    again.stream([13], final=True)
    again.close()
    until_tracked(14)
    second = air.agent(200)
    second.stream(range(3))
    former = json.loads((tmp_path / "previous-1" / "summary.json").read_text())
    assert (former["frames"]["tracked"], former["drops"]) == (14, {})
    assert running.finish(stop=True)["frames"]["tracked"] == 3


def test_what_was_saved_of_a_former_start_is_not_taken_for_the_new_one(tmp_path, air):
    running = air.serve(out=tmp_path)
    first = air.agent(100)
    first.stream(range(8))
    assert first.ask("save").ok
    assert (tmp_path / "trajectory.tum").exists()
    first.close()
    second = air.agent(200)
    second.stream(range(4))
    results = {"trajectory.tum", "map.ply", "reconstruction.npz", "settings.toml"}
    assert not results & {path.name for path in tmp_path.iterdir()}
    assert results < {path.name for path in (tmp_path / "previous-1").iterdir()}
    running.finish(stop=True)


def test_each_start_of_the_agent_is_shown_in_a_recording_of_its_own(tmp_path, air):
    running = air.serve(out=tmp_path, view=ViewSettings(view="file"))
    for epoch in (100, 200):
        radio = air.agent(epoch)
        radio.stream(range(6))
        radio.close()
    running.finish(stop=True)
    for folder, own, other in (
        (tmp_path / "previous-1", b"cam0-100", b"cam0-200"),
        (tmp_path, b"cam0-200", b"cam0-100"),
    ):
        shown = (folder / "run.rrd").read_bytes()
        assert own in shown
        assert other not in shown


def test_what_is_shown_of_a_start_counts_the_frames_that_it_lost_itself(tmp_path, air, monkeypatch):
    submit, lost = SuccessiveViews.submit, {}

    def noted(views, view, *args, **kwargs):
        if view is not None:
            lost.setdefault(running.server._sessions.current.identity.agent_epoch, []).append(
                {path: n for path, n in view.scalars.items() if path.startswith("drops/")}
            )
        submit(views, view, *args, **kwargs)

    monkeypatch.setattr(SuccessiveViews, "submit", noted)
    running = air.serve(out=tmp_path, view=ViewSettings(view="file"))
    first = air.agent(100)
    first.stream([0])
    first.send(1, digest="0" * 16)
    running.wait_for_drop("codec")
    first.stream([2])
    first.close()
    second = air.agent(200)
    second.stream(range(2))
    running.finish(stop=True)
    assert lost == {
        100: [{"drops/all": 0.0}, {"drops/all": 1.0, "drops/codec": 1.0}],
        200: 2 * [{"drops/all": 0.0, "drops/codec": 0.0}],
    }


def test_a_new_start_that_cannot_be_shown_is_tracked_all_the_same(tmp_path, air, monkeypatch, caplog):
    running = air.serve(out=tmp_path, view=ViewSettings(view="file"))
    first = air.agent(100)
    first.stream(range(6))
    first.close()

    def full(*_, **__):
        raise RuntimeError("No space left on device")

    monkeypatch.setattr(RerunStream, "__init__", full)
    second = air.agent(200)
    second.stream(range(4))
    second.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 4
    assert "run.rrd can't be written: No space left on device" in caplog.text
    assert (tmp_path / "previous-1" / "run.rrd").stat().st_size > 0


def test_a_new_start_whose_reference_is_gone_is_tracked_without(tmp_path, air, caplog):
    reference = shutil.copytree(DEMO, tmp_path / "reference")
    running = air.serve(reference=reference)
    first = air.agent(100)
    first.stream(range(3))
    first.close()
    shutil.rmtree(reference)
    # It is read again for another camera.
    stored = air.sequence.stored_camera
    air.sequence = open_sequence(DEMO, replace(stored, fx=1.01 * stored.fx), resize=0.5, max_frames=24)
    second = air.agent(200)
    second.stream(range(4))
    second.close()
    summary = running.finish(stop=True)
    assert summary["frames"]["tracked"] == 4
    assert summary["psnr_db"] is None
    assert f"the new stream has no PSNR and no true path: no sequence at {reference}" in caplog.text


def test_a_folder_that_another_server_writes_into_is_refused(tmp_path, open_air):
    with open_air() as air, open_air() as other:
        air.serve(out=tmp_path)
        with pytest.raises(ConfigError, match=f"another run is writing into {tmp_path}"):
            other.serve(out=tmp_path)
        other.serve(out=tmp_path / "another")


def test_a_restarted_server_goes_on_with_the_map_of_its_checkpoint(tmp_path, open_air):
    with open_air() as air:
        running = air.serve(out=tmp_path, checkpoint_interval_s=0.1)
        radio = air.agent(100)
        radio.stream(range(16))
        before = {p.frame_id: p for p in radio.poses if p.T_world_cam is not None}
        assert len(before) > 10
        running.finish(stop=True)
    (tmp_path / "summary.json").unlink()

    with open_air() as air:
        radio = air.agent(100)
        running = air.serve(out=tmp_path)
        for k in range(16, 24):  # the camera turns back and sees what it saw before
            radio.send(k, picture=30 - k)
            radio.wait(lambda k=k: k in radio.posed_ids(), f"an answer to frame {k}")
        summary = running.finish()
    after = {p.frame_id: p for p in radio.poses if p.T_world_cam is not None}
    assert summary["resumed"]
    assert summary["frames"]["tracked"] == 24
    assert len(after) >= 6
    # The same world: a place seen again has the place it had before the restart.
    step = np.linalg.norm(centre(before[14]) - centre(before[13]))
    for k in after:
        assert np.linalg.norm(centre(after[k]) - centre(before[30 - k])) < 0.5 * step


def test_frames_dropped_before_a_restart_are_in_the_summary_of_the_run(tmp_path, open_air):
    def stream_but_one(air, ids):
        radio = air.agent(100)
        for k in ids:
            if k == ids[len(ids) // 2]:
                radio.send(k, digest="0" * 16)
                running.wait_for_drop("codec")
            else:
                radio.stream([k])

    with open_air() as air:
        running = air.serve(out=tmp_path, checkpoint_interval_s=3600.0)
        stream_but_one(air, range(7))
        assert running.finish(stop=True)["drops"] == {"codec": 1}
    for num_before, ids in ((1, range(7, 12)), (2, range(12, 24))):
        with open_air() as air:
            running = air.serve(out=tmp_path, checkpoint_interval_s=3600.0)
            stream_but_one(air, ids)
            summary = running.finish(stop=ids.stop < 24)
        assert summary["resumed"]
        assert summary["drops"] == {"codec": num_before + 1}
    assert summary["frames"]["tracked"] == 21


def test_a_lossless_server_that_is_stopped_on_the_way_and_started_again_loses_no_frame(tmp_path, open_air):
    with open_air() as air:
        running = air.serve(mode="replay", out=tmp_path)
        radio = air.agent(100, lossless=True)
        for k in range(WINDOW):  # more than one is in work
            radio.send(k)
        radio.wait(radio.posed_ids, "an answer")
        tracked = running.finish(stop=True)["frames"]["tracked"]
    confirmed = radio.allowed - WINDOW
    assert confirmed <= tracked

    with open_air() as air:
        running = air.serve(mode="replay", out=tmp_path)
        radio = air.agent(100, lossless=True)
        radio.stream(range(confirmed, 24), base_seq=confirmed)
        summary = running.finish()
    assert summary["resumed"]
    assert summary["frames"]["tracked"] == 24


def test_another_agent_epoch_does_not_inherit_the_checkpoint(tmp_path, open_air):
    for epoch in (100, 200):
        with open_air() as air:
            running = air.serve(out=tmp_path, checkpoint_interval_s=0.1)
            air.agent(epoch).stream(range(6))
            summary = running.finish(stop=True)
        assert not summary["resumed"]
        assert summary["frames"]["tracked"] == 6


def test_a_former_start_that_cannot_be_written_does_not_stop_the_new_one(tmp_path, air, caplog, monkeypatch):
    def full(path, *rest):
        if path.parent.name == "previous-1":
            raise OSError(28, "No space left on device")
        write_ply(path, *rest)

    monkeypatch.setattr("semcast.server.run_results.write_ply", full)
    running = air.serve(out=tmp_path)
    for epoch, num_frames in ((100, 6), (200, 4)):
        radio = air.agent(epoch)
        radio.stream(range(num_frames))
        radio.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 4
    former = tmp_path / "previous-1"
    assert f"outputs can't be written to {former}: map.ply: No space left on device" in caplog.text
    assert json.loads((former / "summary.json").read_text())["frames"]["tracked"] == 6
    assert len((former / "frames.jsonl").read_text().splitlines()) == 6, "what was written is kept"
    assert len((tmp_path / "frames.jsonl").read_text().splitlines()) == 4
    assert running.server.metrics.counts["errors"] == 1


def test_a_new_start_that_cannot_be_written_is_kept_in_memory(tmp_path, air, caplog):
    running = air.serve(out=tmp_path, bundle="process")
    first = air.agent(100)
    first.stream(range(6))
    first.close()
    (tmp_path / "frames.jsonl.part").mkdir()
    second = air.agent(200)
    second.stream(range(4))
    second.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 4
    assert "frames.jsonl can't be written" in caplog.text
    assert json.loads((tmp_path / "summary.json").read_text())["frames"]["tracked"] == 4
    assert not (tmp_path / "frames.jsonl").exists()


def test_a_first_stream_that_cannot_be_begun_on_as_asked_does_not_end_a_server_that_keeps_running(
    tmp_path, air, caplog
):
    out, reference = tmp_path / "out", shutil.copytree(DEMO, tmp_path / "reference")
    view = ViewSettings(view="file")
    running = air.serve(out=out, reference=reference, view=view, keep_running=True)
    shutil.rmtree(reference)
    out.rmdir()
    out.write_text("in the way")
    agent = air.agent(100)
    agent.stream(range(4))
    for told in (
        "the new stream has no PSNR and no true path: no sequence at",
        f"outputs can't be written to {out}",
        f"the new stream is not shown: {out / 'run.rrd'} can't be written",
    ):
        assert told in caplog.text
    with pytest.raises(SemcastError, match="outputs can't be written"):
        running.finish(stop=True)
    assert running.server.metrics.counts["tracked"] == 4


def test_a_late_frame_of_the_former_start_does_not_end_the_new_one(tmp_path, air):
    running = air.serve(out=tmp_path)
    first = air.agent(100)
    first.stream(range(4))
    second = air.agent(200)
    second.wait(lambda: second.allowed > 0, "the server is ready for the new start")
    first.send(4)
    running.wait_for_drop("epoch")
    second.stream(range(4))
    summary = running.finish(stop=True)
    assert summary["frames"]["tracked"] == 4
    assert summary["drops"]["epoch"] == 1
    assert not (tmp_path / "previous-2").exists()


def test_a_former_start_that_goes_on_sending_is_taken_up_again(air, monkeypatch):
    monkeypatch.setattr("semcast.server.former_starts.STRAGGLER_NS", 0)
    running = air.serve()
    first = air.agent(100)
    first.stream(range(4))
    second = air.agent(200)
    second.wait(lambda: second.allowed > 0, "the server is ready for the new start")
    second.close()
    first.stream(range(4, 8))
    assert running.finish(stop=True)["frames"]["tracked"] == 4


def test_a_start_with_an_earlier_clock_is_followed_after_a_silence(air, monkeypatch):
    monkeypatch.setattr("semcast.server.arrival.SILENCE_NS", 0)
    running = air.serve()
    for epoch, num_frames in ((200, 4), (100, 6)):
        radio = air.agent(epoch)
        radio.stream(range(num_frames))
        radio.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 6


def test_a_server_that_comes_after_the_agent_records_its_camera_too(tmp_path, air):
    radio = air.agent(100)
    running = air.serve(record=tmp_path / "run.mcap")
    radio.stream(range(4))
    running.finish(stop=True)
    (stream,) = recorded_streams(RecordingReader(tmp_path / "run.mcap"))
    assert stream.camera == radio.camera
    assert "semcast.stream.100" in RecordingReader(tmp_path / "run.mcap").info().metadata


@pytest.mark.parametrize("is_restarted", [False, True])
def test_a_first_frame_from_far_ahead_costs_two_others_and_not_the_stream(
    tmp_path, open_air, caplog, is_restarted
):
    caplog.set_level(logging.INFO)
    with contextlib.ExitStack() as stack:
        air = stack.enter_context(open_air())
        running, radio = air.serve(out=tmp_path), air.agent(100)
        radio.send(0, frame_id=2**62)
        radio.wait(lambda: radio.posed_ids() == [2**62], "an answer to the wrong frame")
        if is_restarted:
            stack.close()
            air = stack.enter_context(open_air())
            running, radio = air.serve(out=tmp_path), air.agent(100)
        for k in (1, 2):
            radio.send(k)
        radio.stream(range(3, 12))
        summary = running.finish(stop=True)
    assert summary["frames"]["tracked"] == 9
    assert summary["frames"]["posed"] == 9
    assert summary["resumed"] is False
    assert f"frame {2**62} was wrong: the stream is at 3" in caplog.text
    assert is_restarted == ("map restored from the checkpoint" in caplog.text)


def test_an_announcement_that_no_agent_stands_by_does_not_end_a_map(air):
    running = air.serve()
    radio = air.agent(100)
    radio.stream(range(4))
    radio._announce.put(pack(replace(radio.camera, agent_epoch=2**62)))
    radio.stream(range(4, 8))
    assert running.finish(stop=True)["frames"]["tracked"] == 8


@pytest.mark.parametrize("mode", ["live", "replay"])
def test_an_agent_of_the_other_mode_ends_no_map_and_is_told_of(air, mode, caplog):
    running = air.serve(mode=mode)
    radio = air.agent(100, lossless=mode == "replay")
    radio.stream(range(6))
    other = air.agent(200, lossless=mode == "live")
    until(lambda: "give both one --mode" in caplog.text, "a word on the modes")
    radio.stream(range(6, 12))
    radio.wait(lambda: 11 in radio.posed_ids(), "an answer to frame 11")
    assert other.allowed == 0, "nobody is ready for it"
    summary = running.finish(stop=True)
    assert summary["frames"]["tracked"] == 12
