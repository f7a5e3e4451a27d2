"""A process ends in order while one of its threads is in a library."""

import subprocess
import sys

#: A command that ends while a thread of its own comes back from OpenCV time and again.
COMMAND = """
import atexit, sys, threading
import semcast.__main__, semcast.cli

def run():
    import cv2, numpy as np
    begun = threading.Event()

    def work():
        image = np.ones((512, 512), np.uint8)
        while True:
            cv2.GaussianBlur(image, (31, 31), 3.0)
            begun.set()

    threading.Thread(target=work, daemon=True, name="semcast-decode").start()
    atexit.register(print, "what libraries do in the end")
    assert begun.wait(60)
    {end}

semcast.cli.main = run
sys.exit(semcast.__main__.main())
"""


def end_of(end):
    done = subprocess.run(
        [sys.executable, "-c", COMMAND.format(end=end)], capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stdout, done.stderr


def test_a_thread_that_is_still_at_work_does_not_abort_the_process():
    assert end_of("return 130") == (130, "what libraries do in the end\n", "")


def test_nor_does_it_when_ctrl_c_or_an_error_ends_the_command():
    assert end_of("raise KeyboardInterrupt") == (130, "what libraries do in the end\n", "")
    code, said, error = end_of("raise RuntimeError('not foreseen')")
    assert (code, said) == (1, "what libraries do in the end\n")
    assert error.strip().endswith("RuntimeError: not foreseen")
