"""The Rerun viewer as a child process: a window, or a web server on loopback.

The child runs in a session of its own: Ctrl-C in the terminal does not reach it, and closing it takes the
whole group, because ending the wrapper alone would leave the viewer behind.
"""

import importlib.util
import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO, Literal

from semcast.common.errors import ConfigError

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
MAX_RESTARTS = 3
TERM_DEADLINE_S = 1.0


def rerun_binary() -> Path:
    """Return the viewer that came with the installed SDK.

    Raises:
        ConfigError: The SDK is not installed or came without a viewer.
    """
    spec = importlib.util.find_spec("rerun_cli")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
    for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
        if spec is not None and (folder / name).exists():
            return folder / name
    raise ConfigError(
        "no Rerun viewer is installed: pip install '.[server]' in a checkout of semcast, or use --view none"
    )


def window_display() -> str | None:
    """Return where a window can open: the display's name, or None on a machine without one."""
    if sys.platform in ("darwin", "win32"):
        return sys.platform
    return os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or None


def is_listening(port: int) -> bool:
    """Tell whether something accepts connections on a loopback port; a frozen process still does."""
    try:
        with socket.create_connection((LOOPBACK, port), timeout=0.2):
            return True
    except OSError:
        return False


class ViewerProcess:
    """Starts a viewer, restarts it when it was killed, and leaves none behind.

    A window the user closed (exit status 0) stays closed; a viewer that crashed or was killed is started
    again, at most ``MAX_RESTARTS`` times. A viewer that already listens on the port is used as it is and
    never ended.

    Args:
        kind: ``native`` for a window, ``web`` for a server that browsers open.
        port: Where the viewer takes the stream.
        web_port: Where the web page is; only for ``web``.
        memory_limit: What the viewer may keep, such as ``1GB``; the oldest data goes first.
        command: The program and leading arguments; None takes the installed viewer.
    """

    def __init__(
        self,
        kind: Literal["native", "web"],
        port: int,
        web_port: int,
        memory_limit: str,
        command: tuple[str, ...] | None = None,
    ) -> None:
        self.kind = kind
        self._port = port
        self._web_port = web_port
        self._memory_limit = memory_limit
        self._command = command if command is not None else (str(rerun_binary()),)
        self._child: subprocess.Popen[bytes] | None = None
        self._stderr: IO[bytes] | None = None
        self._restarts = 0
        self._done = False

    @property
    def pid(self) -> int | None:
        """Process id of the running child, None where there is none of ours."""
        return self._child.pid if self._child is not None else None

    @property
    def url(self) -> str:
        """Where a browser finds the web viewer, or where a viewer takes the stream."""
        stream = f"rerun+http://{LOOPBACK}:{self._port}/proxy"
        if self.kind == "native":
            return stream
        return f"http://{LOOPBACK}:{self._web_port}/?url=" + stream.replace("+", "%2B")

    @property
    def restart_command(self) -> str:
        """The command that opens this viewer again by hand."""
        options = " ".join(("--serve-web", "--web-viewer-port", str(self._web_port)))
        tail = f" {options}" if self.kind == "web" else ""
        return f"rerun --bind {LOOPBACK} --port {self._port}{tail}"

    def _arguments(self) -> list[str]:
        arguments = [*self._command, "--bind", LOOPBACK, "--port", str(self._port)]
        arguments += ["--server-memory-limit", self._memory_limit]
        if self.kind == "web":
            return [*arguments, "--serve-web", "--web-viewer-port", str(self._web_port)]
        return [*arguments, "--memory-limit", self._memory_limit, "--expect-data-soon"]

    def start(self) -> None:
        """Start the child unless a viewer already listens on the port; only the first call does anything.

        Raises:
            ConfigError: The program can't be started.
        """
        if self._done or self._child is not None:
            return
        if is_listening(self._port):
            logger.info("using the viewer that already listens on port %d", self._port)
            self._done = True
            return
        self._spawn()

    def _spawn(self) -> None:
        if self._stderr is not None:
            self._stderr.close()
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - read when the child ends
        try:
            self._child = subprocess.Popen(
                self._arguments(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._stderr,
                start_new_session=True,
                env={**os.environ, "RERUN_APP_ONLY": "true"},
            )
        except OSError as err:
            raise ConfigError(f"the viewer can't be started: {err}") from err

    def supervise(self) -> None:
        """Look after the child; call a few times a second. Restarts a viewer that was killed."""
        if self._child is None or self._done:
            return
        status = self._child.poll()
        if status is None:
            return
        self._end_group()
        self._child = None
        if status == 0:
            logger.info("viewer closed, the stream goes on; open it again with: %s", self.restart_command)
            self._done = True
        elif self._restarts >= MAX_RESTARTS:
            logger.warning(
                "viewer ended %d times (last status %d: %s), the stream goes on without it; open it with: %s",
                self._restarts + 1,
                status,
                self._last_words(),
                self.restart_command,
            )
            self._done = True
        elif not is_listening(self._port):
            self._restarts += 1
            logger.info("viewer ended with status %d, starting it again", status)
            self._spawn()
        else:
            self._done = True

    def _last_words(self) -> str:
        if self._stderr is None:
            return ""
        self._stderr.seek(0)
        lines = self._stderr.read()[-2000:].decode("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else "no message"

    def _end_group(self, kind: signal.Signals = signal.SIGKILL) -> None:
        """Signal every process of the child's session; those already gone are ignored."""
        if self._child is not None:
            try:
                os.killpg(self._child.pid, kind)
            except (ProcessLookupError, PermissionError):
                logger.debug("viewer group %d is gone", self._child.pid)

    def release(self) -> None:
        """Leave a running child to the user, who closes its window; it is no longer looked after."""
        self._done = True
        if self._child is not None and self._child.poll() is None:
            logger.info("the viewer is left open")
            # The child outlives this process on purpose: Popen must not complain about that.
            self._child.returncode = 0
            self._child = None

    def close(self) -> None:
        """End the child and its group, also when frozen. Idempotent."""
        self._done = True
        if self._child is not None:
            self._end_group(signal.SIGTERM)
            deadline = time.monotonic() + TERM_DEADLINE_S
            while self._child.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            self._end_group(signal.SIGKILL)
            self._child.wait(timeout=TERM_DEADLINE_S)
            self._child = None
        if self._stderr is not None:
            self._stderr.close()
            self._stderr = None
