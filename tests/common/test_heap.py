import ctypes
import subprocess
import sys

import pytest

from semcast.common.heap import keep_freed_memory

FRAMES = """
import resource, sys
import numpy as np
from semcast.common.heap import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()
def frame():
    arrays = [np.ones(size << 20, np.uint8) for size in (3, 9, 9, 20, 1)]
    return sum(int(array[-1]) for array in arrays)
for _ in range(3):
    frame()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    frame()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(mode):
    done = subprocess.run([sys.executable, "-c", FRAMES, mode], check=True, capture_output=True, text=True)
    return int(done.stdout)


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or not hasattr(ctypes.CDLL(None), "mallopt"), reason="needs glibc"
)
def test_frames_get_the_memory_of_the_frames_before():
    # 42 MB are more than 10000 pages; interpreters and allocators touch a few of their own.
    assert faults("keep") < 1000 < faults("plain")


def test_other_systems_are_left_as_they_are(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_freed_memory()


def test_other_c_libraries_are_left_as_they_are(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not keep_freed_memory()
