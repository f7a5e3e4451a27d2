"""``semcast eval recording``: what recording costs beside a live stream, and how long it holds senders up."""

import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semcast import __version__
from semcast.common.errors import SourceError
from semcast.common.recorder import Recorder
from semcast.common.recording_reader import RecordedMessage, RecordingReader
from semcast.common.recording_writer import recording_metadata
from semcast.evaluation.report import provenance, write_result

VERB = "eval recording"
UNUSED_FIELDS: frozenset[str] = frozenset()


@dataclass(frozen=True, kw_only=True)
class RecordingSettings:
    """Settings of ``evaluate_recording``.

    Raises:
        ValueError: A value is out of range.
    """

    file: Path = field(
        metadata={"help": "recording whose messages are recorded again, at a rate", "positional": True}
    )
    rate_hz: float = field(default=15.0, metadata={"help": "frames a second"})
    round_s: float = field(default=10.0, metadata={"help": "length of a round in seconds"})
    rounds: int = field(default=3, metadata={"help": "rounds with and as many without the recorder"})
    json: Path | None = field(default=None, metadata={"help": "file for the result, - for stdout"})

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 0.1 <= self.rate_hz <= 1000.0:
            raise ValueError(f"rate_hz must be in [0.1, 1000], got {self.rate_hz:g}")
        if not 0.1 <= self.round_s <= 3600.0:
            raise ValueError(f"round_s must be in [0.1, 3600], got {self.round_s:g}")
        if self.rounds < 1:
            raise ValueError(f"rounds must be at least 1, got {self.rounds}")
        if self.num_frames < 1:
            raise ValueError(
                f"round_s must be long enough for a frame at {self.rate_hz:g} Hz, got {self.round_s:g}"
            )

    @property
    def num_frames(self) -> int:
        """Frames of a round."""
        return round(self.rate_hz * self.round_s)


def by_frame(messages: Iterable[RecordedMessage]) -> list[list[RecordedMessage]]:
    """Group messages so that each group begins with a frame the agent sent; what came before is left out."""
    groups: list[list[RecordedMessage]] = []
    for message in messages:
        if message.topic.endswith("/tx/symbols"):
            groups.append([])
        if groups:
            groups[-1].append(message)
    return groups


def evaluate_recording(settings: RecordingSettings) -> dict[str, Any]:
    """Feed a recorder at a steady rate and compare the process's CPU time with rounds without one.

    Returns:
        ``core_share`` (median over rounds of extra CPU time over wall time), ``put_us`` (how long a sender
        was held up for each message), ``bytes_per_s``, ``dropped``, and provenance.

    Raises:
        SourceError: The file is no recording or holds no frames.
    """
    groups = by_frame(RecordingReader(settings.file).messages())
    if not groups:
        raise SourceError(f"{settings.file} holds no frames an agent sent")
    with_s, without_s, put_us, written, dropped = [], [], list[float](), 0, 0
    for _ in range(settings.rounds):  # alternating, so that a busy machine hits both alike
        without_s.append(_round(settings, groups, None, put_us))
        with tempfile.TemporaryDirectory() as folder:
            recorder = Recorder(Path(folder) / "cost.mcap", recording_metadata("", __version__))
            with recorder:
                with_s.append(_round(settings, groups, recorder, put_us))
            written += recorder.bytes_written
            dropped += sum(recorder.drops.values())
    shares = [(a - b) / settings.round_s for a, b in zip(with_s, without_s, strict=True)]
    report = {
        "core_share": float(np.median(shares)),
        "core_share_rounds": shares,
        "put_us": {"p50": float(np.median(put_us)), "p99": float(np.percentile(put_us, 99))},
        "bytes_per_s": written / (settings.rounds * settings.round_s),
        "dropped": dropped,
        **provenance(VERB, settings),
    }
    return write_result(settings.json, report)


def _round(
    settings: RecordingSettings,
    groups: Sequence[Sequence[RecordedMessage]],
    recorder: Recorder | None,
    put_us: list[float],
) -> float:
    """Return the CPU seconds of one round."""
    began_s, cpu_s = time.monotonic(), time.process_time()
    for k in range(settings.num_frames):
        for message in groups[k % len(groups)]:
            since_ns = time.perf_counter_ns()
            if recorder is not None:
                recorder.put(message.topic, message.kind, message.data)
                put_us.append((time.perf_counter_ns() - since_ns) * 1e-3)
        time.sleep(max(0.0, began_s + (k + 1) / settings.rate_hz - time.monotonic()))
    return time.process_time() - cpu_s
