"""``semcast eval server``: how long a live server takes for a frame, with no agent and channel beside it.

A recorded stream is played to a server of its own process, as ``semcast play`` does. The server runs as with
``semcast server``, but shows nothing and leaves out the dense cloud.
"""

import contextlib
import json
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semcast.agent.play import PlaySettings, run_play
from semcast.common.codec import PRECISION_HELP, Precision
from semcast.common.cores import check_threads
from semcast.common.errors import SemcastError
from semcast.common.keys import rx_key
from semcast.common.loopback import free_endpoint
from semcast.common.messages import SymbolFrame
from semcast.common.network_settings import NetworkSettings
from semcast.common.playback import usual_period_ns
from semcast.common.recorded_streams import RecordedStream, choose_stream
from semcast.common.recording_reader import RecordingReader
from semcast.common.role import Role
from semcast.common.run_folder import SUMMARY_NAME
from semcast.common.wire import WireError, unpack
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.report import provenance, write_result

VERB = "eval server"
UNUSED_FIELDS: frozenset[str] = frozenset()
#: Longest time from the last frame to the summary: the adjustment of a long map takes a minute.
_CONCLUDED_S = 300.0


@dataclass(frozen=True, kw_only=True)
class ServerRunSettings:
    """Settings of ``evaluate_server``.

    Raises:
        ValueError: A value is out of range.
    """

    file: Path = field(
        metadata={"help": "recording whose received symbols are played to the server", "positional": True}
    )
    stream: int | None = field(default=None, metadata={"help": "which start of an agent, counted from 1"})
    pace: float = field(default=1.0, metadata={"help": "1: as recorded, 2: twice as fast"})
    threads: int = field(default=1, metadata={"help": "CPU threads of the decoder"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    runs: int = field(default=3, metadata={"help": "runs, each of a new server"})
    json: Path | None = field(default=None, metadata={"help": "file for the result, - for stdout"})

    def __post_init__(self) -> None:
        """Check ranges."""
        self.play_to(NetworkSettings())
        check_threads(self.threads)
        if self.runs < 1:
            raise ValueError(f"runs must be at least 1, got {self.runs}")

    def play_to(self, network: NetworkSettings) -> PlaySettings:
        """Return how the stream is played to a server."""
        return PlaySettings(file=self.file, stream=self.stream, pace=self.pace, network=network)


def evaluate_server(settings: ServerRunSettings) -> dict[str, Any]:
    """Play a stream to a live server, as often as asked for.

    Returns:
        Provenance; of the stream ``sequence``, ``codec``, ``image_wh`` and ``rate_hz``, its usual frames a
        second as they are played; ``results``, of each run ``frames``, ``drops``, ``completeness`` and
        ``stage_ms`` as in the server's summary.

    Raises:
        SourceError: The file is no recording or holds no frames that were received.
        SemcastError: The server ended before the stream did, left no summary, or decoded none of the frames.
    """
    reader = RecordingReader(settings.file)
    stream = choose_stream(reader, settings.stream, "received")
    results: list[dict[str, Any]] = []
    with until_interrupted(results) as part:
        for _ in range(settings.runs):
            results.append(_run(settings, stream))
    report = {
        **provenance(VERB, settings),
        "sequence": stream.camera.source_name,
        "codec": stream.camera.codec,
        "image_wh": list(stream.camera.image_wh),
        "rate_hz": _rate_hz(reader, stream) * settings.pace,
        "results": results,
    }
    return write_result(settings.json, report, part)


def _rate_hz(reader: RecordingReader, stream: RecordedStream) -> float:
    """Return how many frames a second arrived, usually; one that was sent again counts once."""
    first_ns: dict[int, int] = {}
    for message in reader.messages(frozenset({"symbols"})):
        if message.topic != rx_key(stream.agent_id):
            continue
        with contextlib.suppress(WireError):  # it is not played either, which is said then
            frame = unpack(message.data, SymbolFrame)
            if frame.agent_epoch == stream.camera.agent_epoch:
                first_ns.setdefault(frame.seq, message.log_time_ns)
    return 1e9 / max(1.0, usual_period_ns(np.array(list(first_ns.values()), np.int64)))


def _run(settings: ServerRunSettings, stream: RecordedStream) -> dict[str, Any]:
    """Play the stream to a server and return what it tells of it."""
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory(prefix="semcast-") as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "semcast", "server", "--agent-id", stream.agent_id]
        command += ["--listen", endpoint, "--view", "none", "--dense-cloud", "none", "--out", str(out)]
        command += ["--threads", str(settings.threads), "--precision", settings.precision]
        server = Role("server", command, Path(folder) / "server.log")
        server.start()
        has_ended = threading.Event()

        def watch() -> None:
            server.wait()
            has_ended.set()  # also where it never gets as far as to be played to

        threading.Thread(target=watch, name="semcast-server", daemon=True).start()
        try:
            played = run_play(settings.play_to(NetworkSettings(connect=(endpoint,))), has_ended)
            in_time = has_ended.wait(_CONCLUDED_S)
        finally:
            server.stop()
        if not in_time:
            raise SemcastError(f"the server did not end within {_CONCLUDED_S:g} s: {server.last_words()}")
        if not played["complete"] or server.returncode or not (out / SUMMARY_NAME).is_file():
            raise SemcastError(f"the server did not get to the end: {server.last_words()}")
        summary = json.loads((out / SUMMARY_NAME).read_text(encoding="utf-8"))
    if not summary["frames"]["tracked"]:
        drops = ", ".join(f"{count} {reason}" for reason, count in summary["drops"].items())
        raise SemcastError(f"the server decoded no frame of {settings.file}; dropped: {drops or 'none'}")
    return {key: summary[key] for key in ("frames", "drops", "completeness", "stage_ms")}
