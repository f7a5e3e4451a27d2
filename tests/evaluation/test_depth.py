"""Depth from decoded images is held against the truth of a drawn scene, or against that of the originals."""

import json

import cv2
import numpy as np
import pytest

from semcast.common.errors import SourceError
from semcast.common.sequence import open_sequence
from semcast.evaluation.depth import DepthSettings, evaluate_depth
from semcast.evaluation.keyframe_depth import DepthKeyframe, confirmed_depths, reconstructed
from semcast.evaluation.pipeline import run_frames
from semcast.evaluation.result_table import result_table
from semcast.evaluation.results_page import results_page
from semcast.server.dense.neighbours import DepthRange
from semcast.server.dense.view import view_of
from semcast.server.mapping.settings import ReconstructionSettings


def test_a_recording_is_measured_against_its_originals(room, phase_codec, tmp_path):
    settings = DepthSettings(
        sequence=room,
        codec=("phase",),
        snr_db=(20.0, -5.0),
        max_frames=18,
        out=tmp_path,
        json=tmp_path / "depth_room.json",
    )
    report = evaluate_depth(settings, [phase_codec])
    assert report == json.loads((tmp_path / "depth_room.json").read_text())
    assert report["command"].startswith("semcast eval depth --sequence room --codec phase")
    assert (report["reference"], report["num_keyframes"] >= 4) == ("original", True)
    rows = {(row["snr_db"], row["confidence"]): row for row in report["results"]}
    assert list(rows) == [(20.0, "on"), (20.0, "off"), (-5.0, "on"), (-5.0, "off")]
    good, poor = rows[20.0, "off"], rows[-5.0, "off"]
    assert good["coverage"] > poor["coverage"] + 0.2
    assert good["median_error"] < 0.02
    assert good["psnr_db"] > poor["psnr_db"] + 3
    assert good["lost"] == 0.0
    strip = cv2.imread(str(tmp_path / "depth.png"))
    assert strip.shape[1] > 2 * 384, "the original and its depth are side by side"
    assert len(result_table("depth", report).rows) == 4
    assert f"| phase | 20 | off | {good['coverage']:.1%} |" in results_page(tmp_path)


def test_a_drawn_scene_is_measured_against_its_exact_depth(phase_codec):
    settings = DepthSettings(
        scene="orbit", seconds=0.8, poses="true", codec=("phase",), snr_db=(20.0,), confidence=("off",)
    )
    report = evaluate_depth(settings, [phase_codec])
    assert report["reference"] == "exact"
    clean, decoded = report["results"]
    assert (clean["codec"], clean["snr_db"], decoded["codec"]) == ("none", None, "phase")
    assert clean["coverage"] > 0.3
    assert clean["median_error"] < 0.01
    assert clean["coverage"] > decoded["coverage"]


def test_wrong_poses_confirm_next_to_nothing(room):
    sequence = open_sequence(room)
    ids = list(range(0, 24, 2))
    images = {k: sequence.image(k) for k in ids}
    views = {k: view_of(k, image, None, sequence.intrinsics, 8_000) for k, image in images.items()}
    truth = sequence.groundtruth()
    place = {k: DepthKeyframe(truth.T_world_cam[k], DepthRange(2.0, 5.0, 9.0)) for k in ids}
    swapped = {k: place[(7 * k + 4) % 24] for k in ids}
    right, wrong = (
        np.mean([np.isfinite(depth).mean() for depth in confirmed_depths(frames, views).values()])
        for frames in (place, swapped)
    )
    assert right > 0.5
    assert wrong < 0.2 * right


def test_keyframes_know_between_which_depths_their_landmarks_are(room):
    sequence = open_sequence(room)
    frames = run_frames(sequence, list(range(24)), None, None)
    poses, keyframes = reconstructed(frames, sequence.intrinsics, ReconstructionSettings())
    assert set(keyframes) <= set(poses)
    for frame in keyframes.values():
        assert 0 < frame.sought.nearest < frame.sought.median < frame.sought.farthest
    k, frame = next(iter(keyframes.items()))
    moved = frame.with_poses_of(np.eye(4), 2.0)
    assert moved.sought == pytest.approx([2 * depth for depth in frame.sought])
    np.testing.assert_array_equal(frame.T_world_cam, poses[k])


def test_images_without_movement_are_refused(tmp_path, phase_codec):
    (tmp_path / "images").mkdir()
    for k in range(6):
        cv2.imwrite(str(tmp_path / "images" / f"{k:06d}.png"), np.full((96, 128, 3), 90, np.uint8))
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(6)))
    (tmp_path / "intrinsics.json").write_text(
        json.dumps({"fx": 100, "fy": 100, "cx": 63.5, "cy": 47.5, "width": 128, "height": 96})
    )
    with pytest.raises(SourceError, match="no keyframes"):
        evaluate_depth(DepthSettings(sequence=tmp_path, codec=("phase",)), [phase_codec])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"codec": ()}, "codec must be"),
        ({"confidence": ("on", "on")}, "confidence must be"),
        ({"seconds": 0.0}, "seconds must be"),
        ({"snr_db": (99.0,)}, "snr_db must be"),
        ({"max_frames": 0}, "max_frames must be"),
    ],
)
def test_settings_out_of_range_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        DepthSettings(**given)
