"""A role of a running system as a child process: its command, its log, its end."""

import re
import signal
import subprocess
from pathlib import Path

from semcast.common.parent import bound_to_this

#: How long a role may take to write everything after it was asked to stop.
STOP_DEADLINE_S = 30.0


class Role:
    """One child process with its log file."""

    def __init__(self, name: str, command: list[str], log: Path) -> None:
        self.name, self.command, self.log = name, command, log
        self._process: subprocess.Popen[bytes] | None = None
        self.told = False

    def start(self) -> None:
        """Start the process in a group of its own, so that Ctrl-C reaches it only through us.

        It ends with this one, however that ends; one that is started by hand later on does not.
        """
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=bound_to_this(),
            )

    @property
    def returncode(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return None if self._process is None else self._process.poll()

    def last_words(self) -> str:
        """Return the last line of the log."""
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "no output"

    def warnings(self) -> list[str]:
        """Return what the log warns of, each once, in the order in which it came."""
        log = self.log.read_text(encoding="utf-8", errors="replace")
        return list(dict.fromkeys(re.findall(r"^\S+ WARNING \S+: (.+)$", log, re.MULTILINE)))

    def wait(self) -> None:
        """Wait until the process has ended; it was started."""
        assert self._process is not None
        self._process.wait()

    def stop(self) -> None:
        """Ask the process to end; kill it when it does not in time."""
        if self._process is None or self._process.poll() is not None:
            return
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(STOP_DEADLINE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
