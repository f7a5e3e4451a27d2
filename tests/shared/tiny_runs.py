"""Short training runs of the smallest real network."""

import torch

import semcast.common.nets.registry as registry
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.training.data import CropSettings
from semcast.training.settings import TrainSettings

TINY = registry.Architecture("3dcsc", Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8), build_3dcsc)


def settings_for(photos, out, **changes):
    values = {
        "architecture": "3dcsc",
        "data": photos,
        "out": out,
        "batch": 2,
        "steps": 6,
        "warmup_steps": 2,
        "head_every": 2,
        "log_every": 2,
        "save_every": 3,
        "bf16": False,
        "device": "cpu",
        "crop": CropSettings(size_px=32),
    }
    return TrainSettings(**(values | changes))


def final_state(out):
    return torch.load(out / "last.pt", weights_only=True)
