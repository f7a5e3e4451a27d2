"""What is left of a measurement that Ctrl-C or another signal ends: the part that was finished."""

from collections.abc import Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from semcast.common.interrupts import ending_signals, signals_handled

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
    """Let other signals that end a process do what Ctrl-C does in this context, and not on the spot."""

    def end(_number: int, _frame: object) -> NoReturn:
        raise KeyboardInterrupt

    with signals_handled(ending_signals(), end):
        yield
