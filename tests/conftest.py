"""How the tests run side by side, and shared fixtures."""

import functools
import gc
import os
import re
import signal
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

# Threads of several processes that wait for each other by spinning cost a factor of three on two cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import numpy as np
import pytest

# How long an example takes says more about what else the machine does than about the code.
hypothesis.settings.register_profile("any machine", deadline=None)
hypothesis.settings.load_profile("any machine")


def pytest_configure() -> None:
    """Hear Ctrl-C, which a shell lets everything ignore that it starts in the background, tests included."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Search for no garbage among tests and modules, which all stay: a tenth of the time to collect them.

    Nor later on, when half a million of them would be looked through again and again.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep a file's tests in one process, for its fixtures, and those marked "real-time" in one: in turn.

    xdist's own groups are names appended to a test's id, which pytest forgets from 9.2 on.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(config.rootpath / nodeid.split("::")[0])

    return ByFile(config, log) if config.getoption("dist") == "loadgroup" else None


@functools.cache
def group_of(file: Path) -> str:
    """Return the group a file is marked for, or its own."""
    marked = re.search(r"^pytestmark = pytest\.mark\.xdist_group\(\"(.+)\"\)$", file.read_text("utf-8"), re.M)
    return marked[1] if marked else str(file)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Escape what is no text in captured output, which processes of the tests send each other as UTF-8."""
    report = yield
    report.sections = [
        (name, text.encode(errors="backslashreplace").decode()) for name, text in report.sections
    ]
    return report


@pytest.fixture(scope="session", autouse=True)
def one_thread_of_torch() -> Iterator[None]:
    """Leave torch one thread, however many a codec is loaded with: they stay for all tests that follow.

    On a busy machine those that follow take twenty times as long then.
    """
    with pytest.MonkeyPatch.context() as patch:
        if torch := sys.modules.get("torch"):  # as good as always: tests import it
            patch.setattr(torch, "set_num_threads", lambda num: None)
        yield


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
