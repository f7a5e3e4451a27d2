"""Tests that share a fixture or the clock run in one process, whatever others do beside them."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from semcast.common.nets.codec import NeuralCodec
from tests.conftest import group_of

ROOT = Path(__file__).resolve().parents[1]

TESTS = """
import os
import pytest
{mark}
@pytest.mark.parametrize("k", range(6))
def test_where(k, request):
    with open(request.path.with_suffix(".pids"), "a") as file:
        file.write(f"{{os.getpid()}} ")
"""


@pytest.mark.slow
def test_a_file_is_in_one_process_and_all_that_need_the_clock_are_in_one(tmp_path):
    mark = 'pytestmark = pytest.mark.xdist_group("real-time")'
    (tmp_path / "conftest.py").write_text((ROOT / "tests/conftest.py").read_text(encoding="utf-8"))
    for name, marked in (("plain", ""), ("other", ""), ("clock", mark), ("watch", mark)):
        (tmp_path / f"test_{name}.py").write_text(TESTS.format(mark=marked))
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "2", "--dist", "loadgroup", str(tmp_path)]
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert "24 passed" in done.stdout, done.stdout + done.stderr
    plain, other, clock, watch = (
        set((tmp_path / f"test_{name}.pids").read_text().split())
        for name in ("plain", "other", "clock", "watch")
    )
    assert len(plain) == len(other) == len(clock) == len(watch) == 1
    assert clock == watch
    assert len(plain | other | clock) == 2


def test_a_codec_with_more_threads_leaves_one_to_the_tests_that_follow(tiny_weights):
    NeuralCodec.load(tiny_weights, num_threads=4)
    assert torch.get_num_threads() == 1


def test_every_mark_of_a_group_is_understood():
    marked = [
        file for file in (ROOT / "tests").rglob("test_*.py") if "mark.xdist_group(" in file.read_text("utf-8")
    ]
    marked.remove(Path(__file__).resolve())
    assert len(marked) > 5
    assert {group_of(file) for file in marked} == {"real-time"}


def test_what_was_loaded_to_collect_the_tests_is_not_looked_through_for_garbage():
    assert gc.get_freeze_count() > 50_000
    assert gc.isenabled()
