"""What long-running verbs share: settings from a file and flags, and a clean stop on signals."""

import argparse
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from semcast.commands.paths import named_path
from semcast.common.config_flags import add_flags, given_values, settings_from
from semcast.common.interrupts import ending_signals, signals_handled
from semcast.common.parent import stop_with_parent

S = TypeVar("S")

#: Exit code of a run that Ctrl-C ended.
INTERRUPTED = 130
#: A request to end (SIGTERM) that comes again sooner is the same one: ``timeout`` sends it to a process and
#: then to its group.
_AGAIN_S = 1.0


def add_settings(parser: argparse.ArgumentParser, cls: type, skip: frozenset[str] = frozenset()) -> None:
    """Add ``--config`` and one flag per setting of ``cls`` but those to skip, which are the command's own."""
    parser.add_argument(
        "--config",
        type=named_path,
        metavar="FILE",
        help="TOML file with any of these settings, written as snr_db for --snr-db; flags win over it",
    )
    parser.set_defaults(skipped_settings=skip)
    add_flags(parser, cls, skip)


def read_settings(cls: type[S], arguments: argparse.Namespace) -> S:
    """Build the settings that ``add_settings`` declared."""
    return settings_from(cls, arguments, arguments.config, arguments.skipped_settings)


def read_given(cls: type, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what was given of the settings that ``add_settings`` declared; see ``given_values``."""
    return given_values(cls, arguments, arguments.config, arguments.skipped_settings)


class Interrupted:
    """Tells afterwards whether Ctrl-C (not another signal) ended the run."""

    def __init__(self) -> None:
        self.by_user = False


@contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[Interrupted]:
    """Set ``stop`` on Ctrl-C and ``ending_signals``; Ctrl-C after one of them raises ``KeyboardInterrupt``.

    So does SIGTERM after another. A hang-up does not: a terminal that goes may send several.
    """
    interrupted = Interrupted()
    first_s: dict[int, float] = {}

    def handle(number: int, _frame: object) -> None:
        now_s = time.monotonic()
        is_asked_again = number == signal.SIGTERM and now_s - first_s.get(number, now_s) >= _AGAIN_S
        if (number == signal.SIGINT and first_s) or is_asked_again:
            raise KeyboardInterrupt
        first_s.setdefault(number, now_s)
        interrupted.by_user = number == signal.SIGINT or interrupted.by_user
        stop.set()

    with signals_handled([signal.SIGINT, *ending_signals()], handle):
        yield interrupted


def run_until_stopped(work: Callable[[threading.Event], object]) -> int:
    """Call ``work(stop)`` with signals wired to ``stop``; exit code ``INTERRUPTED`` after Ctrl-C, else 0.

    A role of a demo stops with the demo, too.
    """
    stop = threading.Event()
    with stop_on_signals(stop) as interrupted, stop_with_parent(stop):
        work(stop)
    return INTERRUPTED if interrupted.by_user else 0
