"""What the demo's processes are doing, from outside: which are there, how far they are, which gave up."""

import contextlib
import json
import re
import shlex
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semcast.common.errors import SemcastError
from semcast.common.messages import StatusMessage
from semcast.common.role import Role
from semcast.common.run_folder import FRAMES_NAME, SUMMARY_NAME
from semcast.common.wire import WireError, unpack

#: How long a role may take from its start until it is seen: imports and weights on a slow machine.
START_DEADLINE_S = 180.0
#: What a role that gave up ends with; others are of signals or of wrong usage.
ERROR_CODE = 1
_LOOK_INTERVAL_S = 0.1
#: How long after the end of a role its last words, or the summary that it wrote, may take to be seen.
_GRACE_S = 1.0


@dataclass
class Alive:
    """Which roles are there, as liveliness tokens say, and what they count; those restarted by hand too."""

    roles: set[str]
    changed: threading.Condition
    num_outages: int = 0
    num_unreadable: int = 0
    activity: str = ""
    has_sent_all: bool = False

    def on_change(self, role: str, alive: bool | None) -> None:
        """Take one change."""
        with self.changed:
            (self.roles.add if alive else self.roles.discard)(role)
            self.changed.notify_all()

    def on_status(self, payload: bytes) -> None:
        """Take what agent and server say of themselves."""
        with contextlib.suppress(WireError):
            status = unpack(payload, StatusMessage)
            if status.role == "server":
                self.num_outages = status.drops.get("outage", 0)
                self.activity = status.activity
            else:
                self.num_unreadable = status.drops.get("unreadable", 0)
                self.has_sent_all = status.ended

    def wait_for(self, role: str, child: Role, stop: threading.Event) -> None:
        """Wait until a role is there.

        Raises:
            SemcastError: Its process ended, or the deadline passed.
        """
        deadline = time.monotonic() + START_DEADLINE_S
        with self.changed:
            while role not in self.roles and not stop.is_set():
                if child.returncode is not None:
                    raise SemcastError(f"{role} did not start: {child.last_words()}")
                if time.monotonic() > deadline:
                    raise SemcastError(f"{role} was not ready within {START_DEADLINE_S:g} s, see {child.log}")
                self.changed.wait(0.1)


class _NewLines:
    """Lines that the server adds to a file, each once; a file that got shorter is read from its start."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.read_bytes = 0

    def take(self) -> list[str]:
        """Return the lines that are whole and were not returned yet."""
        if not self._path.exists():
            return []
        size = self._path.stat().st_size
        if size < self.read_bytes:
            self.read_bytes = 0
        with self._path.open("rb") as file:
            file.seek(self.read_bytes)
            complete = file.read(size - self.read_bytes).rpartition(b"\n")[0]
        self.read_bytes += len(complete) + bool(complete)
        return [line.decode("utf-8", "replace") for line in complete.splitlines()]


def watch(
    out: Path,
    children: Mapping[str, Role],
    alive: Alive,
    stop: threading.Event,
    tell: Callable[[str], None],
    progress: Callable[[int, str], None],
) -> str | None:
    """Follow the rows the server writes until its summary is there, or until ``stop``.

    Args:
        out: Folder of the outputs.
        children: The processes, ``server`` among them.
        alive: What they say of themselves.
        stop: Ends it.
        tell: Takes one line of text for the user.
        progress: Takes the number of images that are done with, and how it stands in words.

    Returns:
        Which process gave up, and why; None where none did.
    """
    rows, server_log = _NewLines(out / FRAMES_NAME), _NewLines(children["server"].log)
    num_done = num_outages = 0
    activity = ""
    is_page_told = False  # a server that is started again serves the same one
    ended_s: dict[str, float] = {}

    def is_expected(name: str) -> bool:
        """Tell whether that a role ended without an error may be right."""
        since_s = ended_s.setdefault(name, time.monotonic())
        return (name == "agent" and alive.has_sent_all) or time.monotonic() - since_s < _GRACE_S

    while not stop.is_set() and not (out / SUMMARY_NAME).exists():
        for said in server_log.take():
            if (page := re.search(r"viewer: (http\S+)", said)) is not None and not is_page_told:
                is_page_told = True
                tell(f"open {page.group(1)}")
        if (error := _who_gave_up(children.values(), tell, is_expected)) is not None:
            return error
        for row in map(json.loads, rows.take()):
            num_done = row["frame_id"] + 1
            progress(num_done, _standing(row))
        if not rows.read_bytes and alive.num_outages > num_outages:
            num_done = num_outages = alive.num_outages
            progress(num_done, f"no image could be decoded, {num_outages} outages")
        if alive.activity != activity:
            activity = alive.activity
            progress(num_done, activity)
        with alive.changed:
            alive.changed.wait(_LOOK_INTERVAL_S)
    return None


def _who_gave_up(
    children: Iterable[Role], tell: Callable[[str], None], is_expected: Callable[[str], bool]
) -> str | None:
    """Return which process gave up, and why; tell once of each that only ended how it is started again.

    One that is asked to end (SIGTERM) does so without an error, and the others wait for it.
    """
    for child in children:
        code = child.returncode
        if code is None or child.told or (code == 0 and is_expected(child.name)):
            continue
        child.told = True
        if code == ERROR_CODE or (child.name == "agent" and code > 0):
            return f"the {child.name} gave up: {child.last_words()}"
        by_signal = f"was killed by signal {-code}"
        with_code = f"ended with code {code}: {child.last_words()}" if code else "ended before its time"
        how = by_signal if code < 0 else with_code
        tell(f"{child.name} {how}; start it again with: {shlex.join(child.command)}")
    return None


def _standing(row: Mapping[str, Any]) -> str:
    psnr = row["psnr_db"]
    quality = "" if psnr is None else f"  {psnr:.1f} dB"
    return f"{row['state']:<12} {row['num_inliers']:>4} inliers{quality}"
