"""Settings of training runs."""

import math
from pathlib import Path

import pytest

import semcast.common.nets.registry as registry
from semcast.common.config import build_settings, read_toml
from semcast.common.nets.registry import architectures
from semcast.training.losses import LossSettings
from semcast.training.settings import TrainSettings


def test_settings_are_checked():
    with pytest.raises(ValueError, match="batch must be >= 1, got 0"):
        TrainSettings(batch=0)
    with pytest.raises(ValueError, match="lr must be > 0"):
        TrainSettings(lr=0.0)
    for values in (
        {"lr": math.nan},
        {"clip": math.inf},
        {"minutes": math.nan},
        {"seed": -1},
        {"seed": 2**40},
    ):
        with pytest.raises(ValueError, match=next(iter(values)) + " must be"):
            TrainSettings(**values)


def test_heads_alone_need_a_network_and_a_loss(tmp_path):
    with pytest.raises(ValueError, match="grow_from must name the weights"):
        TrainSettings(only_heads=True)
    with pytest.raises(ValueError, match="confidence must be > 0 when only_heads is set"):
        TrainSettings(only_heads=True, grow_from=tmp_path, loss=LossSettings(confidence=0.0))


def test_every_shipped_settings_file_is_valid():
    folder = Path(registry.__file__).resolve().parents[2] / "training"
    files = sorted(folder.glob("*.toml"))
    assert "3dcsc-lite" in {f.stem for f in files}
    for file in files:
        settings = build_settings(TrainSettings, read_toml(file))
        assert settings.architecture == file.stem or file.stem in ("heads", "variable")  # for several
        assert settings.architecture in architectures()
