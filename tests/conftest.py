"""Shared fixtures."""

import signal

import numpy as np
import pytest


def pytest_configure() -> None:
    """Hear Ctrl-C, which a shell lets everything ignore that it starts in the background, tests included."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240611)


@pytest.fixture(scope="session")
def tiny_weights(tmp_path_factory):
    """The weights of a small ``3dcsc`` that was never trained, in a file."""
    import torch

    from semcast.common.nets.checkpoint import save_transceiver
    from semcast.common.nets.transceiver import Sizes, build_3dcsc

    torch.manual_seed(0)
    sizes = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)
    file = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    facts = {"architecture": "3dcsc", "sizes": sizes, "cbr": 1 / 16, "snr_range_db": (0.0, 14.0)}
    save_transceiver(build_3dcsc(sizes), file, made_by={"steps": 0}, **facts)
    return file
