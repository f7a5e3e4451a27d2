"""Children of the demo, when the demo is killed."""

import subprocess
import sys
import time

DEADLINE_S = 30.0

#: A role that works until it is asked to stop, and a demo that does nothing but to start it.
ROLE = """
from semcast.commands.running import run_until_stopped
run_until_stopped(lambda stop: (print("at work", flush=True), stop.wait(60)))
print("ended in order", flush=True)
"""
DEMO = """
import sys, time
from pathlib import Path
from semcast.common.role import Role
Role("role", [sys.executable, "-c", sys.argv[1]], Path(sys.argv[2])).start()
time.sleep(60)
"""

MEASURING = """
import multiprocessing, time
from concurrent.futures import ProcessPoolExecutor
from semcast.common.parent import end_with_parent
pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent)
print(pool.submit(abs, -1).result(), flush=True)
time.sleep(60)
"""


def wait_for(log, words):
    deadline_s = time.monotonic() + DEADLINE_S
    while words not in (log.read_text() if log.exists() else ""):
        assert time.monotonic() < deadline_s, f"not within {DEADLINE_S:g} s: {words}"
        time.sleep(0.02)


def test_a_role_ends_in_order_when_the_demo_is_killed(tmp_path):
    log = tmp_path / "role.log"
    demo = subprocess.Popen([sys.executable, "-c", DEMO, ROLE, str(log)])
    try:
        wait_for(log, "at work")
    finally:
        demo.kill()
        demo.wait()
    wait_for(log, "ended in order")


def test_what_the_demo_measures_by_ends_when_the_demo_is_killed():
    demo = subprocess.Popen([sys.executable, "-c", MEASURING], stdout=subprocess.PIPE)
    try:
        assert demo.stdout.readline() == b"1\n"
    finally:
        demo.kill()
    # The end of what all its processes together write.
    assert demo.communicate(timeout=DEADLINE_S)[0] == b""
