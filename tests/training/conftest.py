"""Photographs, and a network that learns little of them in no time."""

import cv2
import numpy as np
import pytest
from tiny_runs import TINY

import semcast.common.nets.registry as registry
import semcast.training.run as run


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(4):
        small = rng.integers(0, 256, size=(12, 16, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.resize(small, (128, 96), interpolation=cv2.INTER_CUBIC))
    return folder


@pytest.fixture
def few_crops_to_fold(monkeypatch):
    """Passing as many as a real run does takes longer than the few steps of these."""
    monkeypatch.setattr(run, "_FOLD_BATCHES", 2)


@pytest.fixture
def tiny_network(monkeypatch):
    """Register the smallest real network under the name of the main one."""
    monkeypatch.setattr(registry, "_entries", lambda: (TINY,))
