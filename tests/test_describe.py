"""``semcast info`` and ``semcast plot`` on what semcast itself writes."""

import io
import json

import cv2
import numpy as np
import pytest

from semcast.cli import main
from semcast.common.errors import SemcastError
from semcast.common.recording import RecordingWriter, recording_metadata
from semcast.common.trajectory import Trajectory, write_tum
from semcast.describe import describe
from semcast.server.run_record import FrameRow, RunRecord


def text_of(path):
    return "\n".join(f"{head}\n" + "\n".join(f"{k}: {v}" for k, v in lines) for head, lines in describe(path))


def write_recording(path, cut=0):
    stream = io.BytesIO()
    writer = RecordingWriter(stream, recording_metadata('agent_id = "a"\n', "1.2.3"))
    for k in range(5):
        writer.add("semcast/a/tx/symbols", "symbols", 1_000_000_000 * (k + 1), k, bytes(1024))
    writer.flush()
    if not cut:
        writer.finish()
    path.write_bytes(stream.getvalue())


def straight_path(num=6):
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, 2, 3] = np.arange(num)
    T[:, 0, 3] = 0.1 * np.arange(num) ** 2
    return Trajectory(np.arange(num) * 0.5, T)


@pytest.fixture
def run_folder(tmp_path):
    """A run of six frames, the first without a map, and the sequence with its truth."""
    folder = tmp_path / "run"
    folder.mkdir()
    write_tum(folder / "trajectory.tum", straight_path())
    truth = straight_path()
    truth.T_world_cam[:, :3, 3] *= 2.0
    write_tum(tmp_path / "truth.txt", truth)
    record = RunRecord(folder)
    for k in range(6):
        record.add(
            FrameRow(
                frame_id=k,
                t_source_ns=k * 500_000_000,
                state="tracking" if k else "initializing",
                posed=k > 0,
                num_tracked=100,
                num_inliers=80,
                reprojection_error_px=0.5 if k else None,
                is_keyframe=k % 2 == 1,
                map_epoch=0,
                snr_set_db=10.0,
                snr_estimated_db=9.8,
                psnr_db=None,
                confidence_mean=0.6,
                age_ms=40.0 + k,
                stage_ms={"track": 10.0, "decode": 30.0},
            )
        )
    record.close()
    return folder


def test_a_recording_is_described(tmp_path):
    write_recording(tmp_path / "r.mcap")
    text = text_of(tmp_path / "r.mcap")
    assert "state: whole" in text
    assert "semcast/a/tx/symbols:      5 symbols, 5.0 KiB" in text
    assert "4.0 s" in text
    assert "agent_id: a" in text


def test_a_cut_recording_says_so_and_a_lost_suffix_does_not_matter(tmp_path):
    write_recording(tmp_path / "r.bin", cut=1)
    assert "state: cut off" in text_of(tmp_path / "r.bin")


def test_a_run_without_summary_is_said_to_be_going_on(run_folder):
    assert "the run is going on, or was killed" in text_of(run_folder)


def test_a_run_is_described(run_folder):
    (run_folder / "summary.json").write_text(json.dumps({"psnr_db": 27.123, "completeness": 0.5}))
    text = text_of(run_folder)
    assert "image quality (PSNR): 27.12 dB" in text
    assert "frames with a pose: 50.0%" in text


def test_a_folder_of_photos_says_what_is_missing(tmp_path):
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((48, 64, 3), np.uint8))
    text = text_of(tmp_path)
    assert "images: 3, 64x48 px" in text
    assert "camera: unknown" in text
    assert "intrinsics.json" in text


def test_shipped_weights_are_described():
    from pathlib import Path

    text = text_of(Path("3dcsc-lite"))
    assert "channel uses: 0.0625" in text
    assert "made by" in text


@pytest.mark.parametrize("content", [b"hello", None])
def test_what_it_does_not_know_is_one_clear_error(tmp_path, content):
    path = tmp_path / "x.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SemcastError, match="must be a recording"):
        describe(path)


def test_plots_of_a_run_with_truth(run_folder, tmp_path, capsys):
    assert main(["plot", str(run_folder), "--truth", str(tmp_path / "truth.txt")]) == 0
    files = capsys.readouterr().out.split()
    assert [f.rsplit("/", 1)[1] for f in files] == ["trajectory.png", "timeline.png"]
    for file in files:
        picture = cv2.imread(file)
        assert min(picture.shape[:2]) > 400
        assert picture.std() > 5


def test_plots_as_svg_name_what_they_show(run_folder, tmp_path, capsys):
    out = tmp_path / "pictures"
    truth = str(tmp_path / "truth.txt")
    arguments = ["plot", str(run_folder), "--truth", truth, "--format", "svg", "--out", str(out)]
    assert main(arguments) == 0
    # The estimate is the truth at half the size, which Sim(3) removes.
    assert (out / "trajectory.svg").stat().st_size > 5_000
    assert (out / "timeline.svg").stat().st_size > 5_000


def test_a_folder_that_is_no_run_is_one_clear_error(tmp_path, capsys):
    assert main(["plot", str(tmp_path)]) == 1
    assert "there is nothing to plot" in capsys.readouterr().err
