import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcast.channel.settings import ChannelSettings
from semcast.common.errors import SemcastError
from semcast.common.geometry import T_opencv_opengl
from semcast.common.sequence import open_sequence
from semcast.common.trajectory import read_tum
from semcast.evaluation.pipeline import CLEAN
from semcast.evaluation.trajectory import TrajectorySettings, evaluate_trajectory, median_or_none

PROMISED = (
    "ate_rmse_m",
    "ate_percent",
    "ate_at_once_percent",
    "completeness",
    "completeness_at_once",
    "rpe_trans_percent",
    "rpe_rot_deg",
    "psnr_db",
    "stage_ms",
    "settings",
    "versions",
    "commit",
    "machine",
    "command",
)


def without_times(report):
    text = json.dumps(report)
    report = json.loads(text)
    for key in ("stage_ms", "commit", "settings", "command"):
        report.pop(key, None)
    for cell in report["cells"]:
        for run in cell["runs"]:
            run.pop("stage_ms")
            for row in run.get("rows", []):
                row.pop("stage_ms")
                row.pop("age_ms")
    return report


def test_one_run_has_the_promised_keys_and_files(room, phase_codec, tmp_path):
    settings = TrajectorySettings(
        sequence=room, snr_db=(20.0,), max_frames=16, json=tmp_path / "t.json", out=tmp_path
    )
    report = evaluate_trajectory(settings, phase_codec)
    assert report["settings"]["codec"] == "phase"
    assert json.loads(settings.json.read_text()) == report
    assert all(report[key] is not None for key in PROMISED)
    assert set(report["stage_ms"]["decode"]) >= {"p50", "p95"}
    assert report["completeness"] >= 0.9
    assert report["ate_percent"] < 5
    (cell,) = report["cells"]
    assert cell["confidence"] == "robust"
    assert len(cell["runs"][0]["rows"]) == 16
    posed = read_tum(tmp_path / "trajectory_20db_robust.tum")
    assert len(posed) == cell["runs"][0]["num_posed"]
    assert cv2.imread(str(tmp_path / "path_20db_robust.png")) is not None


def test_a_path_that_can_not_be_written_does_not_cost_the_figures(room, tmp_path):
    (tmp_path / f"trajectory_{CLEAN}_robust.tum").mkdir()
    settings = TrajectorySettings(
        sequence=room, codec="none", max_frames=3, json=tmp_path / "t.json", out=tmp_path
    )
    with pytest.raises(SemcastError, match="can't be written"):
        evaluate_trajectory(settings)
    assert json.loads(settings.json.read_text())["num_frames"] == 3


def test_a_damaged_image_is_told_and_counts_for_nothing(room, tmp_path):
    shutil.copytree(room, tmp_path / "room")
    (tmp_path / "room" / "images" / sorted(p.name for p in (room / "images").iterdir())[7]).write_bytes(b"")
    report = evaluate_trajectory(TrajectorySettings(sequence=tmp_path / "room", codec="none", max_frames=16))
    assert report["frames_left_out"] == [7]
    assert report["num_frames"] == len(report["cells"][0]["runs"][0]["rows"]) == 15
    assert report["completeness"] >= 0.9


def test_the_same_settings_give_the_same_trajectory_bit_for_bit(room, phase_codec, tmp_path):
    def run(folder):
        settings = TrajectorySettings(
            sequence=room, codec="phase", snr_db=(15.0,), max_frames=8, out=tmp_path / folder
        )
        report = evaluate_trajectory(settings, phase_codec)
        return without_times(report), (tmp_path / folder / "trajectory_15db_robust.tum").read_bytes()

    assert run("a") == run("b")


def test_modes_and_seeds_share_decoded_images_and_are_compared(room, phase_codec):
    settings = TrajectorySettings(
        sequence=room,
        codec="phase",
        snr_db=(15.0,),
        seeds=2,
        max_frames=8,
        rows=False,
        confidence=("robust", "off"),
    )
    report = evaluate_trajectory(settings, phase_codec)
    assert phase_codec.num_decoded == 2 * 8
    assert [c["confidence"] for c in report["cells"]] == ["robust", "off"]
    robust, off = report["cells"]
    assert robust["psnr_db"] == off["psnr_db"]
    assert [run["seed"] for run in robust["runs"]] == [0, 1]
    assert "ate_rmse_m" not in report
    assert "rows" not in robust["runs"][0]
    (comparison,) = report["comparisons"]
    assert (comparison["confidence"], comparison["against"]) == ("robust", "off")
    assert comparison["paired"]["num_samples"] == 2
    mean = [sum(run["ate_percent"] for run in cell["runs"]) / 2 for cell in (robust, off)]
    assert comparison["paired"]["difference"] == pytest.approx(mean[0] - mean[1])


def test_clean_originals_need_no_link(room):
    settings = TrajectorySettings(sequence=room, codec="none", snr_db=(2.0, 4.0), max_frames=10)
    report = evaluate_trajectory(settings)
    assert report["snr_db"] is None
    assert report["psnr_db"] is None
    assert report["ate_percent"] < 3


def test_a_dead_link_gives_no_error_figure_and_says_so(room, phase_codec):
    settings = TrajectorySettings(
        sequence=room, codec="phase", max_frames=4, link=ChannelSettings(frame_loss=1.0)
    )
    report = evaluate_trajectory(settings, phase_codec)
    assert report["ate_rmse_m"] is None
    assert report["num_failed"] == 1
    assert report["completeness"] == 0.0


def test_without_a_truth_a_run_is_judged_by_its_poses(room, tmp_path, caplog):
    shutil.copytree(room, tmp_path / "blind")
    (tmp_path / "blind" / "groundtruth.txt").unlink()
    report = evaluate_trajectory(
        TrajectorySettings(sequence=tmp_path / "blind", codec="none", max_frames=10, out=tmp_path / "out")
    )
    assert (report["ate_rmse_m"], report["num_failed"]) == (None, 0)
    assert report["completeness"] >= 0.9
    assert "blind has no true path: how far its poses are off is unknown" in caplog.text


def test_a_truth_in_an_unknown_unit_gives_errors_in_percent_and_no_metres(room, tmp_path):
    native = open_sequence(room)
    truth = native.groundtruth()
    frames = [
        {"file_path": f"images/{path.name}", "transform_matrix": (T @ T_opencv_opengl).tolist()}
        for path, T in zip(sorted((room / "images").iterdir()), truth.T_world_cam, strict=True)
    ]
    camera = native.intrinsics
    document = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
    (tmp_path / "images").symlink_to((room / "images").resolve())
    (tmp_path / "transforms.json").write_text(json.dumps({**document, "frames": frames}))
    settings = TrajectorySettings(
        sequence=tmp_path, codec="none", seeds=2, max_frames=8, confidence=("robust", "off"), rows=True
    )
    report = evaluate_trajectory(settings)
    known = evaluate_trajectory(replace(settings, sequence=room, seeds=1, confidence=("robust",)))
    assert report["cells"][0]["runs"][0]["ate_percent"] == pytest.approx(
        known["cells"][0]["ate_percent"], rel=1e-3
    )
    for cell in report["cells"]:
        assert (cell["ate_rmse_m"], cell["num_failed"]) == (None, 0)
        assert cell["ate_percent"] is not None
        assert {row["error_m"] for row in cell["runs"][0]["rows"]} == {None}
    assert report["comparisons"][0]["paired"]["num_samples"] == 2


@pytest.mark.parametrize("truth", ["100 0 0 0 0 0 0 1\n100.1 1 0 0 0 0 0 1\n", "still"])
def test_a_truth_that_measures_nothing_is_not_a_failure_of_the_run(room, tmp_path, caplog, truth):
    folder = tmp_path / "short"
    shutil.copytree(room, folder)
    if truth == "still":
        lines = (folder / "groundtruth.txt").read_text().splitlines()[1:]
        truth = "".join(f"{line.split()[0]} 0 0 0 0 0 0 1\n" for line in lines)
    (folder / "groundtruth.txt").write_text(truth)
    report = evaluate_trajectory(TrajectorySettings(sequence=folder, codec="none", max_frames=10))
    assert (report["ate_rmse_m"], report["num_failed"]) == (None, 0)
    assert "too short to say how far its poses are off" in caplog.text


def test_images_of_which_each_looks_elsewhere_are_said_to_be_no_stream(room, tmp_path, caplog):
    folder = tmp_path / "views"
    shutil.copytree(room, folder)
    lines = [line for line in (folder / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    turned = [np.radians(75.0 * k / 2) for k in range(len(lines))]
    poses = [
        " ".join([*line.split()[:4], "0", f"{np.sin(a)}", "0", f"{np.cos(a)}"])
        for line, a in zip(lines, turned, strict=True)
    ]
    (folder / "groundtruth.txt").write_text("\n".join(poses))
    evaluate_trajectory(TrajectorySettings(sequence=folder, codec="none", max_frames=3))
    assert "views is no stream: from one image to the next the camera turns by 75 degrees" in caplog.text


def test_a_truth_of_a_part_of_the_recording_is_told(room, tmp_path, caplog):
    folder = tmp_path / "part"
    shutil.copytree(room, folder)
    lines = (folder / "groundtruth.txt").read_text().splitlines(keepends=True)
    num_images = len(list((folder / "images").iterdir()))
    settings = TrajectorySettings(sequence=folder, codec="none", max_frames=8)
    evaluate_trajectory(settings)
    assert "errors are those of these alone" not in caplog.text
    (folder / "groundtruth.txt").write_text("".join(lines[:6]))
    evaluate_trajectory(settings)
    num_poses = len(open_sequence(folder).groundtruth())
    assert f"part has true poses of {num_poses} of its {num_images} images: errors are those" in caplog.text


def test_a_failed_run_counts_as_worse_than_any_number():
    assert median_or_none([1.0, None, 2.0]) == 2.0
    assert median_or_none([1.0, None, 2.0], largest_is_best=True) == 1.0
    assert median_or_none([1.0, None, None]) is None
    assert median_or_none([]) is None


def test_a_run_of_which_nothing_arrives_is_worst_in_quality_too(room, phase_codec):
    settings = TrajectorySettings(
        sequence=room, codec="phase", max_frames=2, seeds=5, link=ChannelSettings(frame_loss=0.7)
    )
    (cell,) = evaluate_trajectory(settings, phase_codec)["cells"]
    found = [run["psnr_db"] for run in cell["runs"]]
    assert 0 < found.count(None) <= 2
    assert cell["psnr_db"] == sorted(-np.inf if psnr_db is None else psnr_db for psnr_db in found)[2]


def test_modes_must_be_some_and_different(room):
    with pytest.raises(ValueError, match="confidence"):
        TrajectorySettings(sequence=room, confidence=())
    with pytest.raises(ValueError, match="different"):
        TrajectorySettings(sequence=room, confidence=("off", "off"))
