"""Photograph a web page in headless Chromium after a real wait; needs nothing but Python and Chromium.

Chromium's own ``--screenshot`` takes the picture before a WebAssembly page has drawn anything. This drives it
over the DevTools pipe instead (two file descriptors, JSON messages ending in NUL).

    python3 deploy/photograph_page.py URL OUT.png [WIDTHxHEIGHT] [WAIT_S]
"""

import base64
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

CHROMIUM = os.environ.get("CHROMIUM") or next(
    (name for name in ("chromium", "chromium-browser", "google-chrome") if shutil.which(name)), "chromium"
)
# Software WebGL: there may be no graphics card.
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--hide-scrollbars",
    "--mute-audio",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--remote-debugging-pipe",
)


class Browser:
    """Chromium behind a pipe: ``call`` sends one command and returns its result."""

    def __init__(self, size_wh: tuple[int, int], profile: str) -> None:
        self._from_us, to_browser = os.pipe()
        from_browser, self._to_us = os.pipe()
        self._out, self._in = os.fdopen(to_browser, "wb", buffering=0), os.fdopen(from_browser, "rb")
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}"]
        command += [f"--window-size={size_wh[0]},{size_wh[1]}", "about:blank"]
        # The browser reads descriptor 3 and writes 4; a shell puts ours there.
        shuffle = f'exec "$@" 3<&{self._from_us} 4>&{self._to_us}'
        self._process = subprocess.Popen(
            ["sh", "-c", shuffle, "sh", *command],
            pass_fds=(self._from_us, self._to_us),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(self._from_us)
        os.close(self._to_us)
        self._num_calls = 0

    def call(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
        """Send one DevTools command and wait for its answer.

        Raises:
            RuntimeError: Chromium refused it or has ended.
        """
        self._num_calls += 1
        message: dict[str, Any] = {"id": self._num_calls, "method": method, "params": params}
        if session:
            message["sessionId"] = session
        self._out.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = json.loads(self._receive())
            if answer.get("id") == self._num_calls:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error'].get('message')}")
                result: dict[str, Any] = answer["result"]
                return result

    def _receive(self) -> bytes:
        received = bytearray()
        while (byte := self._in.read(1)) != b"\0":
            if not byte:
                raise RuntimeError(f"{CHROMIUM} ended; is it installed?")
            received += byte
        return bytes(received)

    def close(self) -> None:
        """End Chromium and all its children."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


def photograph(url: str, out: Path, size_wh: tuple[int, int], wait_s: float) -> None:
    """Open ``url``, wait ``wait_s`` seconds and write a PNG."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(size_wh, profile)
        try:
            pages = browser.call("Target.getTargets")["targetInfos"]
            page = next(p["targetId"] for p in pages if p["type"] == "page")
            session = browser.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
            width, height = size_wh
            browser.call(
                "Emulation.setDeviceMetricsOverride",
                session,
                width=width,
                height=height,
                deviceScaleFactor=1,
                mobile=False,
            )
            dark = [{"name": "prefers-color-scheme", "value": "dark"}]
            browser.call("Emulation.setEmulatedMedia", session, features=dark)
            browser.call("Page.navigate", session, url=url)
            time.sleep(wait_s)
            picture = browser.call("Page.captureScreenshot", session, format="png")["data"]
        finally:
            browser.close()
    out.write_bytes(base64.b64decode(picture))


def main(arguments: list[str]) -> int:
    """Run the command line."""
    if not 2 <= len(arguments) <= 4:
        print((__doc__ or "").strip(), file=sys.stderr)
        return 2
    url, out = arguments[0], Path(arguments[1])
    width, height = (int(n) for n in (arguments[2] if len(arguments) > 2 else "1600x960").split("x"))
    wait_s = float(arguments[3]) if len(arguments) > 3 else 25.0
    try:
        photograph(url, out, (width, height), wait_s)
    except (OSError, RuntimeError) as err:
        print(f"no picture was taken: {err}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
