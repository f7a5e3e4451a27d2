import json

import cv2
import numpy as np
import pytest

from semcast.channel.settings import ChannelSettings
from semcast.common.errors import ConfigError
from semcast.common.sequence import open_sequence
from semcast.evaluation.pairs import PairSettings, evaluate_pairs, true_motions
from semcast.evaluation.pipeline import select_frames

KEYS = {
    "rot_deg_mean",
    "rot_deg_median",
    "tdir_deg_mean",
    "tdir_deg_median",
    "auc5",
    "auc10",
    "auc20",
    "num_pairs",
    "num_failed",
    "cpu_ms",
}
METHODS = {"robust", "paper", "off", "plain_ransac", "opencv_ransac", "opencv_magsac", "poselib", "oracle"}


def settings(room, **values):
    base = {"sequence": room, "codec": "phase", "gap": (4,), "max_frames": 7, "snr_db": (20.0,)}
    return PairSettings(**{**base, **values})


def test_all_methods_are_measured_on_the_same_pairs(room, phase_codec, tmp_path):
    wanted = settings(room, snr_db=(6.0, 20.0), json=tmp_path / "p.json", out=tmp_path)
    report = evaluate_pairs(wanted, phase_codec)
    assert json.loads(wanted.json.read_text()) == report
    assert set(report["results"]) == METHODS
    assert all(set(result) == KEYS for result in report["results"].values())
    low, high = report["cells"]
    assert {r["num_pairs"] for r in high["results"].values()} == {3}
    assert report["results"]["off"]["num_pairs"] == 6
    for method in METHODS:
        assert high["results"][method]["rot_deg_median"] < 2.0
    assert low["psnr_db"] < high["psnr_db"]
    assert low["true_inlier_share"]["epipolar"] < high["true_inlier_share"]["epipolar"]
    assert 0 <= report["auroc_confidence"] <= 1
    assert report["auroc_confidence"] == report["auroc"]["epipolar"]["confidence"]
    assert "track" in report["auroc"]
    against = {(c["mode"], c["against"]) for c in high["comparisons"]}
    assert {("robust", "off"), ("paper", "poselib"), ("off", "opencv_ransac")} <= against
    assert cv2.imread(str(tmp_path / "fig9_rotation.png")) is not None


@pytest.mark.parametrize("features", ["orb", "sift"])
def test_descriptor_matches_work_too(room, features):
    report = evaluate_pairs(settings(room, codec="none", features=(features,), confidence=("robust", "off")))
    assert report["results"]["robust"]["rot_deg_median"] < 2.0
    assert report["cells"][0]["num_matches"]["p50"] > 30
    assert set(report["auroc"]) == {"epipolar"}


def test_thinning_leaves_so_many_matches_to_everyone(room, phase_codec):
    report = evaluate_pairs(
        settings(room, max_matches=(40,), confidence=("off",), competitors=False), phase_codec
    )
    assert report["cells"][0]["num_matches"] == {"p5": 40.0, "p50": 40.0}
    assert set(report["results"]) == {"off"}


def test_frames_are_decoded_once_for_all_variants(room, phase_codec):
    wanted = settings(
        room,
        gap=(2, 4),
        features=("klt", "orb"),
        max_matches=(0, 20),
        confidence=("off",),
        competitors=False,
    )
    report = evaluate_pairs(wanted, phase_codec)
    assert phase_codec.num_decoded == 7
    cells = {(c["gap"], c["features"], c["max_matches"]): c for c in report["cells"]}
    assert len(cells) == len(report["cells"]) == 8
    assert cells[2, "klt", 0]["results"]["off"]["num_pairs"] == 5
    assert cells[4, "orb", 20]["results"]["off"]["num_pairs"] == 3
    assert cells[4, "klt", 20]["num_matches"]["p50"] == 20 < cells[4, "klt", 0]["num_matches"]["p50"]
    alone = evaluate_pairs(settings(room, confidence=("off",), competitors=False), phase_codec)
    for result in (alone["cells"][0], cells[4, "klt", 0]):
        result["results"]["off"].pop("cpu_ms")
    assert alone["cells"][0] == cells[4, "klt", 0]
    # Orb matches have no track: the truth of tracks is taken over the others.
    assert set(report["auroc"]["track"]) > set(report["auroc"]["epipolar"])


def test_the_result_is_the_same_every_time(room, phase_codec):
    def run():
        report = evaluate_pairs(settings(room, seeds=2, max_matches=(60,), max_frames=6), phase_codec)
        for results in (report["results"], report["cells"][0]["results"]):
            for result in results.values():
                result.pop("cpu_ms")
        return {key: report[key] for key in ("results", "auroc", "cells")}

    assert run() == run()


def test_ablations_run_on_the_same_matches(room, phase_codec):
    modes = ("off", "constant", "shuffled", "inverted")
    report = evaluate_pairs(settings(room, confidence=modes, competitors=False), phase_codec)
    assert set(report["results"]) == set(modes)
    assert report["results"]["constant"]["num_failed"] == 0


def test_pairs_with_a_lost_frame_fail_under_every_method(room, phase_codec):
    wanted = settings(
        room, max_frames=20, link=ChannelSettings(frame_loss=0.3), confidence=("off",), competitors=False
    )
    report = evaluate_pairs(wanted, phase_codec)
    lost = report["cells"][0]["num_pairs_lost"]
    assert 0 < lost < 16
    assert report["results"]["off"]["num_failed"] >= lost
    assert report["results"]["off"]["num_pairs"] == 16


def test_a_trace_from_a_file_is_one_link_without_an_snr_or_a_curve(room, phase_codec, tmp_path):
    file = tmp_path / "trace.csv"
    file.write_text("t_s,snr_db\n0,12\n")
    link = ChannelSettings(channel="trace", trace="file", trace_file=file)
    with pytest.raises(ValueError, match="snr_db must be a single value with --trace file"):
        settings(room, link=link, snr_db=(2.0, 8.0))
    out = tmp_path / "out"
    chosen = settings(room, link=link, out=out, max_frames=5, confidence=("off",), competitors=False)
    report = evaluate_pairs(chosen, phase_codec)
    assert [cell["snr_db"] for cell in report["cells"]] == [None]
    assert not out.exists()


def test_true_motion_maps_the_first_camera_to_the_second(room):
    sequence = open_sequence(room)
    wanted = settings(room)
    motions = true_motions(sequence, select_frames(sequence, wanted).ids, wanted, 4)
    assert list(motions) == [(k, k + 4) for k in range(3)]
    truth = sequence.groundtruth().T_world_cam
    np.testing.assert_allclose(truth[4] @ motions[0, 4], truth[0], atol=1e-7)


def test_short_baselines_are_left_out(room):
    sequence = open_sequence(room)
    wanted = settings(room, min_baseline_m=10.0)
    with pytest.raises(ConfigError, match="larger --gap"):
        true_motions(sequence, select_frames(sequence, wanted).ids, wanted, 4)
    shared = settings(room, min_baseline_share=0.9)
    with pytest.raises(ConfigError, match="baseline"):
        true_motions(sequence, select_frames(sequence, shared).ids, shared, 4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gap": (0,)}, "gap"),
        ({"gap": ()}, "gap"),
        ({"features": ("klt", "klt")}, "features"),
        ({"max_matches": (4,)}, "max_matches"),
        ({"threshold_px": 0.0}, "threshold_px"),
        ({"min_baseline_share": 1.0}, "min_baseline_share"),
        ({"min_baseline_m": -0.1}, "min_baseline_m"),
        ({"min_baseline_m": float("nan")}, "min_baseline_m"),
        ({"confidence": ()}, "confidence"),
        ({"snr_db": (6.0, 10.0, 6.0)}, "snr_db must be different values, got 6 10 6"),
    ],
)
def test_settings_out_of_range_are_refused(room, values, message):
    with pytest.raises(ValueError, match=message):
        settings(room, **values)
