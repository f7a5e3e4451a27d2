"""What is left of a measurement that Ctrl-C or another signal ends: the part that was finished."""

import signal
import threading
from collections.abc import Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

#: Before the suffix of a file with a part.
_MARK = ".partial"


class InterruptedMeasurementError(KeyboardInterrupt):
    """Ctrl-C, or what does the same, in a measurement of which a part was finished.

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
        return _part_of(path) if self.is_cut else path

    def forget(self, path: Path) -> None:
        """Delete the part that an earlier run left of a result that is whole now."""
        _part_of(path).unlink(missing_ok=True)


def _part_of(path: Path) -> Path:
    return path.with_suffix(f"{_MARK}{path.suffix}")


def is_part(path: Path) -> bool:
    """Tell whether a file is named as ``Part.name`` names that of a part."""
    return path.stem.endswith(_MARK)


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
def ended_like_ctrl_c() -> Iterator[None]:
    """Let a request to end, or a terminal that is gone, do what Ctrl-C does in this context.

    They would end the process on the spot. Under nohup, which has it ignored, a hang-up does nothing.
    """
    if threading.current_thread() is not threading.main_thread():  # the only one that may set handlers
        yield
        return

    def end(_number: int, _frame: object) -> NoReturn:
        raise KeyboardInterrupt

    numbers = [signal.SIGTERM]
    hang_up = getattr(signal, "SIGHUP", None)  # Windows has none
    if hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN:
        numbers.append(hang_up)
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
