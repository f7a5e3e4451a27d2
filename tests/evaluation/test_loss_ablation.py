"""The ablation of loss terms, on a tiny network and for a few steps."""

import dataclasses
import math

import numpy as np
import pytest

from semcast.common.nets.transceiver import Sizes
from semcast.evaluation import loss_ablation
from semcast.training import run
from semcast.training.data import CropSettings
from semcast.training.settings import TrainSettings

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)


@pytest.fixture
def photos(tmp_path):
    import cv2

    rng = np.random.default_rng(0)
    folder = tmp_path / "train"
    folder.mkdir()
    images = []
    for k in range(3):
        image = cv2.resize(
            rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), (128, 96), interpolation=cv2.INTER_CUBIC
        )
        cv2.imwrite(str(folder / f"{k}.png"), image)
        images.append(image)
    return folder, images


def test_variants_switch_terms_and_are_graded(photos, monkeypatch):
    folder, images = photos
    known = run.architecture
    monkeypatch.setattr(run, "architecture", lambda name: dataclasses.replace(known(name), sizes=TINY))
    monkeypatch.setattr(run, "_FOLD_BATCHES", 2)  # the many of a real run take longest here
    settings = TrainSettings(
        data=folder, steps=4, batch=2, head_every=1, crop=CropSettings(size_px=64), threads=1
    )
    rows = {row["loss"]: row for row in loss_ablation.run(settings, images[:2])}
    assert list(rows) == ["reconstruction", "+ confidence", "+ descriptors", "all three"]
    for name, row in rows.items():
        assert 5.0 < row["psnr_db"] < 40.0
        assert row["descriptor"] > 0.0
        assert 0.0 < row["corner_px"] <= 8.0
        graded = name in ("+ confidence", "all three")
        assert math.isfinite(row["ece"]) == graded
    # Confidence heads send no gradient into the picture, so it is the same to the bit.
    assert rows["+ confidence"]["psnr_db"] == rows["reconstruction"]["psnr_db"]
    assert rows["+ descriptors"]["psnr_db"] != rows["reconstruction"]["psnr_db"]
