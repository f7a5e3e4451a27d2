"""Depth from decoded images is held against the truth of a drawn scene, or against that of the originals."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError
from semcast.common.sequence import open_sequence
from semcast.evaluation import depth
from semcast.evaluation.cloud_error import TrueView
from semcast.evaluation.depth import DepthSettings, evaluate_depth
from semcast.evaluation.keyframe_depth import DepthKeyframe, confirmed_depths, reconstructed
from semcast.evaluation.pipeline import run_frames
from semcast.evaluation.result_table import result_table
from semcast.evaluation.results_page import results_page
from semcast.evaluation.scenes import render
from semcast.server.dense.neighbours import DepthRange
from semcast.server.dense.view import view_of
from semcast.server.mapping.settings import ReconstructionSettings


def test_a_recording_is_measured_against_its_originals(room, phase_codec, tmp_path):
    settings = DepthSettings(
        sequence=room,
        codec=("phase",),
        snr_db=(20.0, -5.0),
        max_frames=12,
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
    assert (good["lost"], good["cloud"]) == (0.0, None)
    strip = cv2.imread(str(tmp_path / "depth.png"))
    assert strip.shape[1] > 2 * 384, "the original and its depth are side by side"
    assert len(result_table("depth", report).rows) == 4
    assert f"| phase | 20 | off | {good['coverage']:.1%} |" in results_page(tmp_path)


def test_a_drawn_scene_is_measured_against_its_exact_depth(phase_codec, monkeypatch):
    monkeypatch.setattr(render, "_SAMPLES", ((0.0, 0.0),))  # a fourth of the time to draw it
    settings = DepthSettings(
        scene="orbit",
        scene_seed=1,
        pace="fast",
        seconds=0.8,
        poses="true",
        codec=("phase",),
        snr_db=(20.0,),
        confidence=("off",),
    )
    report = evaluate_depth(settings, [phase_codec])
    assert report["reference"] == "exact"
    clean, decoded = report["results"]
    assert (clean["codec"], clean["snr_db"], decoded["codec"]) == ("none", None, "phase")
    assert clean["coverage"] > 0.3
    assert clean["median_error"] < 0.01
    assert clean["coverage"] > decoded["coverage"]
    cloud = clean["cloud"]
    assert 0 < cloud["accuracy_median"] < 0.01
    assert cloud["completeness"] > max(0.4, decoded["cloud"]["completeness"])


def drawn(truth, metres):
    """A keyframe, 1 to 4 units of depth, whose view has four pixels with these depths in metres."""
    image = np.full((2, 2, 3), 90, np.uint8)
    camera = Intrinsics(fx=2, fy=2, cx=0.5, cy=0.5, width=2, height=2)
    keyframe = DepthKeyframe(np.eye(4), DepthRange(1.0, 2.0, 4.0))
    true = TrueView(np.eye(4), camera, np.asarray(truth, np.float32), [])
    scene = depth._Scene(None, {5: keyframe}, metres, {5: true})
    return depth._Reference(scene, {5: view_of(5, image, None, camera)}, {})


def test_errors_and_their_figures_by_hand():
    against = drawn([[2.0, 4.0], [8.0, np.inf]], metres=2.0)
    # Inverse depths of map units: 2.5 m where 2 m are, nothing, 8 m where 8 m are, and a depth of the sky.
    found = np.array([[0.8, np.nan], [0.25, 0.1]], np.float32)
    errors, num_pixels = against.errors({5: found})
    assert errors.tolist() == pytest.approx([0.25, 0.0, np.inf])
    assert num_pixels == 3
    lost = against.errors({})
    assert (lost[0].tolist(), lost[1]) == ([], 3)
    there = depth._Depths({5: found}, {5: np.zeros((0, 3), np.float32)})
    nowhere = depth._Depths({}, {})
    row = depth._row("x", 6.0, "on", against, [there, nowhere], [20.0, None, 30.0], 0.5)
    assert row["coverage"] == pytest.approx(2 / 6)
    assert row["median_error"] == pytest.approx(0.125)
    assert row["outlier_share"] == pytest.approx(2 / 3)
    assert (row["psnr_db"], row["lost"]) == (25.0, 0.5)
    nothing = depth._row("x", 6.0, "on", against, [nowhere], [None], 1.0)
    assert (nothing["coverage"], nothing["median_error"], nothing["outlier_share"]) == (0.0, None, None)


def test_near_is_red_far_is_blue_and_what_is_not_known_is_black():
    against = drawn(np.ones((2, 2)), metres=1.0)
    (near, far), (nothing, unknown) = against.coloured(5, np.array([[1.0, 0.25], [0.0, np.nan]]))
    assert near[0] > 2 * near[2]
    assert far[2] > far[0]
    assert nothing.tolist() == unknown.tolist() == [0, 0, 0]
    assert against.coloured(5, None, (3, 4)).shape == (3, 4, 3)


def test_depth_of_a_smaller_image_is_that_at_the_centres_of_its_pixels():
    depth_map = np.arange(54, dtype=np.float32).reshape(6, 9)
    # Of three pixels in a row the middle one.
    assert depth._at_centres(depth_map, (2, 3)).tolist() == [[10, 13, 16], [37, 40, 43]]
    np.testing.assert_array_equal(depth._at_centres(depth_map, (6, 9)), depth_map)


def test_wrong_poses_confirm_next_to_nothing(room, monkeypatch):
    monkeypatch.setattr("semcast.server.dense.view.MAX_PIXELS", 8_000)
    sequence = open_sequence(room)
    ids = list(range(0, 24, 2))
    images = {k: sequence.image(k) for k in ids}
    views = {k: view_of(k, image, None, sequence.intrinsics) for k, image in images.items()}
    truth = sequence.groundtruth()
    place = {k: DepthKeyframe(truth.T_world_cam[k], DepthRange(2.0, 5.0, 9.0)) for k in ids}
    swapped = {k: place[(7 * k + 4) % 24] for k in ids}
    right, wrong = (
        np.mean(
            [np.isfinite(found.inverse_depth).mean() for found in confirmed_depths(frames, views).values()]
        )
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
    assert moved.sought == pytest.approx([2 * near for near in frame.sought])
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
        ({"snr_db": (2.0, 2.0)}, "snr_db must be different values, got 2 2"),
        ({"max_frames": 0}, "max_frames must be"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"seed": 2**31 - 2, "seeds": 3}, "last of the seeds must be at most 2147483647, got 2147483648"),
        ({"camera": CameraSettings(focal_35mm=26.0)}, "camera values are of a recording"),
        ({"sequence": Path("room"), "scene": "street"}, "scene is of a scene to draw, .* got street"),
        ({"sequence": Path("room"), "seconds": 9.0}, "seconds is of a scene to draw, .* got 9"),
    ],
)
def test_settings_out_of_range_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        DepthSettings(**given)
