"""What is left of a measurement that Ctrl-C or SIGTERM ends after an hour: the part that was finished."""

import signal
import threading
from collections.abc import Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn


class InterruptedMeasurementError(KeyboardInterrupt):
    """Ctrl-C or SIGTERM in a measurement of which a part was finished.

    Attributes:
        result: That part, marked as ``partial``.
        path: File it was written to, or None.
    """

    def __init__(self, result: dict[str, Any], path: Path | None) -> None:
        super().__init__()
        self.result = result
        self.path = path


class Part:
    """Tells afterwards whether a measurement is only a part of what was to be measured."""

    def __init__(self) -> None:
        self.is_cut = False

    def name(self, path: Path) -> Path:
        """Return the file for a result: that of a part replaces none that is whole."""
        return path.with_suffix(f".partial{path.suffix}") if self.is_cut else path


@contextmanager
def until_interrupted(finished: Sized) -> Iterator[Part]:
    """Measure in this context; where Ctrl-C ends it, what is finished is used.

    Args:
        finished: What the measurement adds to. While it is empty, Ctrl-C is raised as usual.
    """
    part = Part()
    try:
        yield part
    except KeyboardInterrupt:
        if not len(finished):
            raise
        part.is_cut = True


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Let a request to end do what Ctrl-C does in this context; it would end the process on the spot."""
    if threading.current_thread() is not threading.main_thread():  # the only one that may set handlers
        yield
        return

    def end(_number: int, _frame: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
