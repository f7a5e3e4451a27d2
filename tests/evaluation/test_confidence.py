import json

import cv2
import pytest

from semcast.channel.settings import ChannelSettings
from semcast.common.errors import ConfigError
from semcast.evaluation import confidence
from semcast.evaluation.confidence import ConfidenceSettings, evaluate_confidence
from semcast.evaluation.plots import plot_reliability


def test_confidence_is_graded_per_snr_and_written(room, phase_codec, tmp_path, monkeypatch):
    curves = []

    def watched(path, tables, observed, title):
        curves.extend(tables)
        plot_reliability(path, tables, observed, title)

    monkeypatch.setattr(confidence, "plot_reliability", watched)
    settings = ConfidenceSettings(
        sequence=room,
        codec="phase",
        snr_db=(4.0, 20.0),
        max_frames=3,
        link=ChannelSettings(channel="erasure", slot_loss=0.3),
        json=tmp_path / "confidence.json",
        out=tmp_path,
    )
    report = evaluate_confidence(settings, phase_codec)
    assert json.loads(settings.json.read_text()) == report
    assert cv2.imread(str(tmp_path / "reliability.png")) is not None
    assert curves == ["SNR 4 dB", "SNR 20 dB"]
    low, high = report["results"]
    assert (low["snr_db"], high["snr_db"]) == (4.0, 20.0)
    assert low["psnr_db"] < high["psnr_db"]
    for result in (low, high):
        assert result["num_frames"] == 3
        # lost bands are grey: their confidence of 0.01 tells them from the rest
        assert result["slots"]["confidence_lost"] < 0.05
        assert result["slots"]["confidence_received"] > 0.6
        assert 0 < result["pixel"]["ece"] < 1
        assert result["keypoint"]["num_corners"] > 100
    # at 20 dB the lost bands are the errors
    assert high["pixel"]["maps"]["confidence"]["nause"] < 0.8
    assert high["pixel"]["maps"]["constant"]["nause"] == pytest.approx(1.0)
    assert report["command"].startswith("semcast eval confidence --sequence room")


def test_seeds_add_frames(room, phase_codec):
    settings = ConfidenceSettings(sequence=room, codec="phase", max_frames=2, seeds=2)
    assert evaluate_confidence(settings, phase_codec)["results"][0]["num_frames"] == 4


def test_clean_images_have_no_confidence_to_grade(room):
    with pytest.raises(ValueError, match="codec must have a confidence"):
        ConfidenceSettings(sequence=room, codec="none")
    with pytest.raises(ValueError, match="pixel_alpha"):
        ConfidenceSettings(sequence=room, pixel_alpha=0.0)


def test_a_dead_link_is_a_clear_error(room, phase_codec):
    settings = ConfidenceSettings(
        sequence=room, codec="phase", max_frames=2, link=ChannelSettings(frame_loss=1.0)
    )
    with pytest.raises(ConfigError, match="no frame was received"):
        evaluate_confidence(settings, phase_codec)
