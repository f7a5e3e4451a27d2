"""``semcast info`` and ``semcast plot`` on what semcast itself writes."""

import io
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import SECOND, BagMaker
from rows_of_runs import frame_row

from semcast.cli import main
from semcast.common.camera import Intrinsics
from semcast.common.errors import SemcastError, SourceError
from semcast.common.file_lock import lock
from semcast.common.nets.onnx_encoder import encoder_path
from semcast.common.recording_writer import RecordingWriter, recording_metadata
from semcast.common.run_folder import RECONSTRUCTION_NAME, PartInMetres, RunData, write_run
from semcast.common.trajectory import Trajectory, write_tum
from semcast.common.trajectory_error import ate
from semcast.describe import describe
from semcast.server.frame_rows import FrameRows


def text_of(path):
    return "\n".join(f"{head}\n" + "\n".join(f"{k}: {v}" for k, v in lines) for head, lines in describe(path))


def write_images(folder, count, suffix=".png"):
    folder.mkdir(exist_ok=True)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k}{suffix}"), np.zeros((48, 64, 3), np.uint8))


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
    record = FrameRows(folder)
    for k in range(6):
        record.add(
            frame_row(
                k,
                t_source_ns=k * 500_000_000,
                state="tracking" if k else "initializing",
                posed=k > 0,
                reprojection_error_px=0.5 if k else None,
                is_keyframe=k % 2 == 1,
                snr_estimated_db=9.8,
                psnr_db=None,
                confidence_mean=0.6,
                age_ms=40.0 + k,
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
    with (tmp_path / "r.bin").open("ab") as recorder:
        lock(recorder.fileno())
        assert "state: being recorded" in text_of(tmp_path / "r.bin")


def test_a_clock_that_was_set_back_gives_no_negative_length(tmp_path):
    with (tmp_path / "r.mcap").open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata('agent_id = "a"\n', "1.2.3"))
        for t_s in (5000, 5001, 1402):
            writer.add("semcast/a/tx/symbols", "symbols", t_s * 1_000_000_000, 0, bytes(8))
        writer.finish()
    assert "time: 1970-01-01 01:23:20 UTC, the clock was set back meanwhile" in text_of(tmp_path / "r.mcap")


def test_a_run_without_summary_is_said_to_be_going_on(run_folder):
    assert "the run is going on, or was killed" in text_of(run_folder)


@pytest.mark.parametrize("text", ['{"frames": 5}', '{"stream": {"image_wh": 5}}', '{"psnr_db": "good"}'])
def test_the_summary_of_another_program_is_one_line(run_folder, text):
    (run_folder / "summary.json").write_text(text)
    with pytest.raises(SourceError, match=r"summary\.json is none that a run wrote"):
        describe(run_folder)


def test_a_run_is_described(run_folder):
    figures = {"psnr_db": 27.123, "completeness": 0.5, "frame_rate_hz": 7.7, "processed_rate_hz": 3.9}
    (run_folder / "summary.json").write_text(json.dumps(figures))
    text = text_of(run_folder)
    assert "image quality (PSNR): 27.12 dB" in text
    assert "frames with a pose: 50.0%" in text
    assert "tracked by recorded time: 7.7 frames a second" in text
    assert "tracked by time of arrival: 3.9 frames a second" in text


def test_frames_that_came_twice_are_no_dropped_ones(run_folder):
    (run_folder / "summary.json").write_text('{"drops": {"duplicate": 9, "superseded": 29, "too_old": 1}}')
    text = text_of(run_folder)
    assert "dropped frames: 29 superseded, 1 too_old\n" in text
    assert "frames that came twice: 9\n" in text
    (run_folder / "summary.json").write_text('{"drops": {"duplicate": 9}}')
    assert "dropped frames" not in text_of(run_folder)


def test_rows_that_a_killed_run_left_are_described_without_the_last_one(run_folder):
    assert "frames.jsonl: the last" not in text_of(run_folder)
    rows = run_folder / "frames.jsonl"
    rows.write_bytes(rows.read_bytes()[:-40])
    text = text_of(run_folder)
    assert "frames.jsonl: the last line is no whole row: the run was killed, or is writing it" in text
    assert "trajectory.tum: " in text


@pytest.mark.parametrize(
    ("kept", "fault"), [(6, None), (4, "4 rows of the 6 frames"), (0, "0 rows of the 6")]
)
def test_rows_that_are_fewer_than_the_summary_says_are_counted(run_folder, kept, fault, capsys):
    (run_folder / "summary.json").write_text('{"frames": {"tracked": 6}}')
    rows = run_folder / "frames.jsonl"
    rows.write_text("".join(rows.read_text().splitlines(keepends=True)[:kept]))
    assert (f"frames.jsonl: {fault}" in text_of(run_folder)) == (fault is not None)
    assert main(["plot", str(run_folder)]) == 0
    assert (f"frames.jsonl: {fault}" in capsys.readouterr().err) == (fault is not None)


def test_damaged_rows_are_counted_and_the_rest_is_described(run_folder):
    rows = run_folder / "frames.jsonl"
    first, second, *others = rows.read_text().splitlines(keepends=True)
    rows.write_text("".join([first, second[:30] + "\n", *others]))
    text = text_of(run_folder)
    assert f"frames.jsonl: damaged lines: 1, the first: {rows}:2 is not a frame row" in text
    assert "trajectory.tum: " in text


def test_all_files_that_exports_and_viewers_read_are_listed(run_folder):
    (run_folder / "dense.ply").write_bytes(bytes(2048))
    assert "dense.ply: 2.0 KiB" in text_of(run_folder)


def test_a_run_of_one_part_says_nothing_of_parts_and_one_of_two_says_so(run_folder):
    values = {
        "intrinsics": Intrinsics(fx=50, fy=50, cx=31.5, cy=23.5, width=64, height=48),
        "frame_ids": np.arange(1, 6),
        "t_source_ns": np.arange(1, 6) * 500_000_000,
        "T_world_cam": straight_path(5).T_world_cam,
        "keyframe_ids": [],
        "landmark_ids": [],
        "xyz": np.zeros((0, 3)),
        "rgb": np.zeros((0, 3)),
        "confidence": [],
        "landmark_submap": [],
        "observed_landmark_ids": [],
        "observed_keyframe_ids": [],
        "observed_xy": np.zeros((0, 2)),
    }
    write_run(run_folder, RunData(**values, frame_submap=np.zeros(5)))
    assert "parts" not in text_of(run_folder)
    assert "metre" not in text_of(run_folder)
    found = {"marker_id": 7, "num_keyframes": 5, "m_per_unit": 0.25, "relative_sigma": 0.01}
    metres = (PartInMetres(part=0, T_marker_world=np.eye(4), **found),)
    write_run(run_folder, RunData(**values, frame_submap=np.zeros(5), metres=metres))
    assert "metre: a unit of the map is 0.25 m, within 2 % (95 %), by marker 7" in text_of(run_folder)
    write_run(run_folder, RunData(**values, frame_submap=[0, 0, 0, 1, 1], metres=metres))
    assert "metre, part 0: a unit of the map is 0.25 m" in text_of(run_folder)
    told = (
        "parts: 2 (part 0: 3 frames, part 1: 2 frames); the place and scale of all but the first are guessed"
    )
    write_run(run_folder, RunData(**values, frame_submap=[0, 0, 0, 1, 1]))
    assert told in text_of(run_folder)
    (run_folder / RECONSTRUCTION_NAME).unlink()
    parts = [{"submap": 0, "num_posed": 3}, {"submap": 1, "num_posed": 2}]
    (run_folder / "summary.json").write_text(json.dumps({"parts": parts}))
    assert told in text_of(run_folder)


def test_a_folder_of_photos_says_what_is_missing(tmp_path):
    write_images(tmp_path, 3)
    text = text_of(tmp_path)
    assert "images: 3, 64x48 px" in text
    assert "camera: unknown: put intrinsics.json" in text
    assert "intrinsics.json" in text


def test_what_is_wrong_with_a_sequence_is_said_once(tmp_path, caplog):
    write_images(tmp_path / "images", 5)
    (tmp_path / "groundtruth.txt").write_text("1000 0 0 0 0 0 0 1\n1001 0 0 1 0 0 0 1\n")
    assert "true path: none" in text_of(tmp_path)
    assert caplog.text.count("none of its 2 true poses") == 1
    (tmp_path / "groundtruth.txt").unlink()
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "images.txt").write_text("")
    assert "true path: none" in text_of(tmp_path)
    assert caplog.text.count("half a model of COLMAP's") == 1


def test_times_that_nobody_recorded_are_said_to_be_assumed(tmp_path):
    write_images(tmp_path / "images", 5)
    assert "0.4 s, 10.0 images a second, assumed: no times are recorded" in text_of(tmp_path)
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * k:.1f}\n" for k in range(5)))
    assert "10.0 images a second" in text_of(tmp_path)
    assert "assumed" not in text_of(tmp_path)


def test_distortion_and_shutter_of_the_images_as_stored_are_shown(tmp_path):
    write_images(tmp_path, 2)
    camera = {"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
    (tmp_path / "intrinsics.json").write_text(json.dumps({**camera, "distortion": [-0.25, 0.08, 0, 0.0012]}))
    text = text_of(tmp_path)
    assert "cy 23.5 px, with distortion -0.25 0.08 0 0.0012" in text
    assert "shutter: " not in text
    rolling = {**camera, "readout_ms": 18.0, "readout_from": "left"}
    (tmp_path / "intrinsics.json").write_text(json.dumps(rolling))
    assert "shutter: rolling, 18 ms from left" in text_of(tmp_path)
    (tmp_path / "intrinsics.json").write_text(json.dumps(camera))
    assert "with distortion" not in text_of(tmp_path)


def test_a_video_is_described_with_the_camera_beside_it_or_without(tmp_path):
    video = tmp_path / "my walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    for _ in range(4):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    text = text_of(video)
    assert "images: 4, 64x48 px\ntime: 0.2 s, 20.0 images a second\ncamera: unknown: put" in text
    assert f"is reconstructed by: semcast demo --sequence '{video}' --focal-35mm 26" in text
    camera = Intrinsics(fx=50, fy=50, cx=31.5, cy=23.5, width=64, height=48, distortion=(-0.25, 0.08, 0, 0))
    camera.save(video.with_suffix(".json"))
    text = text_of(video)
    assert "camera: fx 50.0 fy 50.0 cx 31.5 cy 23.5 px, with distortion -0.25 0.08 0 0\n" in text
    assert text.endswith(f"is reconstructed by: semcast demo --sequence '{video}'")
    replace(camera, distortion_model="equidistant").save(video.with_suffix(".json"))
    assert "cy 23.5 px, with equidistant distortion -0.25 0.08 0 0\n" in text_of(video)
    Intrinsics(fx=50, fy=50, cx=23.5, cy=31.5, width=48, height=64).save(video.with_suffix(".json"))
    assert "are for 48x64 images, its images are 64x48: are they turned by 90 degrees" in text_of(video)


def test_a_calibration_is_described(tmp_path):
    Intrinsics(fx=50, fy=51, cx=31.5, cy=23.5, width=64, height=48).save(tmp_path / "mine.json")
    assert "images: 64x48 px\ncamera: fx 50.0 fy 51.0" in text_of(tmp_path / "mine.json")
    (tmp_path / "bad.yaml").write_text("image_width: 64\n")
    with pytest.raises(SourceError, match=r"bad.yaml holds no usable intrinsics: "):
        describe(tmp_path / "bad.yaml")


def test_images_that_will_be_refused_are_named(tmp_path, capsys):
    write_images(tmp_path, 4)
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((64, 48, 3), np.uint8))
    text = text_of(tmp_path)
    assert "images: 4, 64x48 px" in text
    assert "refused: 1 of these images" in text
    assert "2.png is 48x64, the first readable image of the sequence is 64x48" in text
    for k in range(4, 12):
        (tmp_path / f"[{k}].jpg").write_bytes(b"broken")
    assert main(["info", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "9 of these images" in shown
    assert "/[4].jpgisnotareadableimage" in "".join(shown.split())  # wherever the line was broken
    assert "and 4 more" in shown


def test_images_beyond_a_quick_look_are_counted(tmp_path):
    write_images(tmp_path, 103, suffix=".bmp")
    text = text_of(tmp_path)
    assert "not looked at: 3 images" in text
    assert "refused" not in text


def test_a_transforms_file_is_described_like_its_folder(tmp_path):
    write_images(tmp_path / "test", 2)
    frames = [{"file_path": f"test/{k}", "transform_matrix": np.eye(4).tolist()} for k in range(2)]
    document = {"camera_angle_x": 0.8, "frames": frames}
    (tmp_path / "transforms_test.json").write_text(json.dumps(document))
    text = text_of(tmp_path / "transforms_test.json")
    assert "images: 2, 64x48 px" in text
    assert "true path: 2 poses, 0.00 in a unit that the recording does not tell" in text
    assert text.splitlines()[1:] == text_of(tmp_path).splitlines()[1:]


def ros_bag(folder):
    bag = BagMaker()
    for k in range(3):
        bag.image("/cam/image_raw", np.zeros((48, 64, 3), np.uint8), "bgr8", (2 + k) * SECOND)
    bag.pose("/mocap", "room", (0.0, 0.0, 0.0), 2 * SECOND)
    bag.transform("/tf_static", "base", "cam", (0.0, 0.0, 0.0), 2 * SECOND)
    return bag.write(folder)


def test_a_ros_bag_is_described_by_what_a_sequence_can_be_made_of(tmp_path):
    text = text_of(ros_bag(tmp_path))
    for line in ("time: 2.0 s", "frames of /tf: base, cam", "/cam/image_raw:      3", "/mocap:      1"):
        assert line in text


def test_a_ros_bag_is_told_where_nothing_can_read_it(tmp_path, monkeypatch):
    monkeypatch.setattr("semcast.describe.find_spec", lambda name: None)
    assert "pip install '.[ros]'" in text_of(ros_bag(tmp_path))


def test_a_bag_unpacked_is_a_sequence(tmp_path, capsys):
    folder = tmp_path / "sequence"
    assert main(["unpack", str(ros_bag(tmp_path)), "--out", str(folder), "--truth", "/mocap"]) == 0
    said = capsys.readouterr()
    assert said.out == f"{folder}\n", "a script can go on with it"
    assert "3 images of /cam/image_raw, camera unknown, 1 true poses" in said.err
    assert "images: 3, 64x48 px" in text_of(folder)


def test_an_exported_encoder_is_described(tmp_path):
    words = text_of(encoder_path("3dcsc-lite"))
    assert "codec: 3dcsc-lite" in words
    assert "convolutions: int8" in words
    assert "trained for: 0..14 dB" in words
    with pytest.raises(SourceError, match=r"there is no file .*nowhere\.onnx"):
        describe(tmp_path / "nowhere.onnx")


def test_shipped_weights_are_described():
    text = text_of(Path("3dcsc-lite"))
    assert "channel uses: 0.0625" in text
    assert "made by" in text


def test_what_weights_of_ones_own_reached_is_told_with_digits_that_count(tiny_weights, tmp_path):
    mine = tmp_path / "mine.safetensors"
    mine.write_bytes(tiny_weights.read_bytes())
    manifest = json.loads(tiny_weights.with_suffix(".json").read_text())
    manifest["measured"] = {"validation": {"psnr_2db": 20.680639983714517}}
    mine.with_suffix(".json").write_text(json.dumps(manifest))
    assert "validation psnr_2db: 20.68\n" in text_of(mine) + "\n"


@pytest.mark.parametrize("content", [b"hello", None])
def test_what_it_does_not_know_is_one_clear_error(tmp_path, content):
    path = tmp_path / "my x.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SemcastError, match="must be a recording"):
        describe(path)


def test_what_is_not_there_is_said_to_be_neither_file_nor_folder_nor_codec(tmp_path):
    with pytest.raises(SemcastError, match="there is no file or folder .*/nowhere: it must be a recording"):
        describe(tmp_path / "nowhere")
    with pytest.raises(SemcastError, match="no file, folder or codec nowhere: .*shipped are: .*3dcsc-lite"):
        describe(Path("nowhere"))


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


def test_a_plot_takes_the_true_path_of_the_frames_whatever_their_camera_and_times(
    run_folder, tmp_path, monkeypatch
):
    sequence = tmp_path / "sequence"
    write_images(sequence, 6)
    # The user gave another camera, and the rate: without times.txt these count ten images a second.
    wrong = {"fx": 9, "fy": 9, "cx": 4, "cy": 4, "width": 8, "height": 8}
    (sequence / "intrinsics.json").write_text(json.dumps(wrong))
    truth = straight_path()
    write_tum(sequence / "groundtruth.txt", Trajectory(np.arange(6) * 0.1, truth.T_world_cam))
    summary = {"settings": {"reference": str(sequence)}}
    (run_folder / "summary.json").write_text(json.dumps(summary))
    drawn = []
    monkeypatch.setattr(
        "semcast.evaluation.run_plots.plot_run", lambda run, out, form: drawn.append(run) or []
    )
    assert main(["plot", str(run_folder)]) == 0
    (run,) = drawn
    np.testing.assert_allclose(run.truth.t_s, truth.t_s)
    assert len(ate(run.trajectory, run.truth).t_s) == 6


@pytest.mark.parametrize("reference", [3, "/gone"])
def test_a_plot_without_the_sequence_it_was_of_has_no_true_path(run_folder, monkeypatch, capsys, reference):
    (run_folder / "summary.json").write_text(json.dumps({"settings": {"reference": reference}}))
    monkeypatch.setattr("semcast.evaluation.run_plots.plot_run", lambda run, out, form: [])
    assert main(["plot", str(run_folder)]) == 0
    told = capsys.readouterr().err
    assert f"the sequence {reference} is gone" in told
    assert "no true path is known" in told


def test_a_folder_that_is_no_run_is_one_clear_error(tmp_path, capsys):
    assert main(["plot", str(tmp_path)]) == 1
    assert "there is nothing to plot" in capsys.readouterr().err
