"""``semcast eval runtime``: how fast a codec encodes and decodes, by runtime, instruction set and threads."""

import json
import os
import subprocess
import sys
from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semcast.common.codec import DEFAULT_CODEC, Precision
from semcast.common.codecs import LEARNED_CODECS, available_codecs, check_codec
from semcast.common.cores import check_threads
from semcast.common.errors import ConfigError, SemcastError
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.report import cpu_flags, provenance, write_result

VERB = "eval runtime"
UNUSED_FIELDS: frozenset[str] = frozenset()
#: Instruction sets oneDNN is held to ("all" leaves it free), and the precision asked for there. onnxruntime
#: always takes its best.
_TORCH: tuple[tuple[str, Precision], ...] = (("all", "auto"), ("AVX2", "auto"), ("AVX2", "float32"))
#: The same where there is no wider set than AVX2, and holding oneDNN to that changes nothing.
_TORCH_NARROW: tuple[tuple[str, Precision], ...] = (("all", "auto"), ("all", "float32"))
#: Flags of processors with a wider one.
_WIDER = frozenset({"avx512f", "avx_vnni"})


@dataclass(frozen=True, kw_only=True)
class RuntimeSettings:
    """Settings of ``evaluate_runtime``.

    Raises:
        ValueError: A value is out of range.
    """

    codecs: tuple[str, ...] = field(
        default=(DEFAULT_CODEC,), metadata={"flag": "codec", "help": "learned codecs to time"}
    )
    width: int = field(default=640, metadata={"help": "image width in pixels"})
    height: int = field(default=480, metadata={"help": "image height in pixels"})
    threads: tuple[int, ...] = field(default=(1, 2), metadata={"help": "numbers of CPU threads"})
    rounds: int = field(default=8, metadata={"help": "rounds; in each every variant has its turn"})
    calls: int = field(default=8, metadata={"help": "calls of a variant in a round"})
    json: Path | None = field(default=None, metadata={"help": "file for the result, - for stdout"})

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("width", "height", "rounds", "calls"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name, values in (("codec", self.codecs), ("threads", self.threads)):
            if not values or len(set(values)) != len(values):
                raise ValueError(f"{name} must be one or more different values, got {values}")
        for num_threads in self.threads:
            check_threads(num_threads)


@dataclass(frozen=True)
class Variant:
    """What is timed: ``encode`` or ``decode`` of a codec on a runtime."""

    codec: str
    work: str
    runtime: str
    isa: str
    precision: Precision
    threads: int


def variants(settings: RuntimeSettings, flags: Collection[str]) -> list[Variant]:
    """Return all variants there are: onnxruntime only encodes, and takes no hint on instruction sets.

    Args:
        settings: What is timed.
        flags: What the processor can do; empty where that is not known.
    """
    torch = _TORCH if not flags or not _WIDER.isdisjoint(flags) else _TORCH_NARROW
    found = []
    for codec in settings.codecs:
        for threads in settings.threads:
            found += [
                Variant(codec, work, "torch", isa, precision, threads)
                for work in ("encode", "decode")
                for isa, precision in torch
            ]
            found.append(Variant(codec, "encode", "onnx", "all", "auto", threads))
    return found


class _Child:
    """A variant in its own process, waiting for its turn."""

    def __init__(self, variant: Variant, shape_hw: tuple[int, int]) -> None:
        self.variant = variant
        self.times_ms: list[float] = []
        self.error: str | None = None
        environment = dict(os.environ)
        if variant.isa != "all":
            environment["ONEDNN_MAX_CPU_ISA"] = variant.isa
        self._process = subprocess.Popen(
            [sys.executable, "-m", "semcast.evaluation.runtime_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self.precision = self._ask({**asdict(variant), "shape_hw": shape_hw})

    def _ask(self, value: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(value) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            assert self._process.stderr is not None
            words = self._process.stderr.read().strip().splitlines()
            self.error = words[-1] if words else "ended without a word"
            return None
        try:
            return json.loads(line)
        except ValueError:
            self.error = f"answered what is no JSON: {line.strip()}"
            return None

    def turn(self, calls: int) -> None:
        """Time some calls."""
        if self.error is None:
            self.times_ms += self._ask(calls) or []

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def evaluate_runtime(settings: RuntimeSettings) -> dict[str, Any]:
    """Time all variants in one run, taking turns.

    Returns:
        ``results``: a row for each variant with the ``precision`` that was taken, ``p50_ms``, ``p95_ms`` and
        ``fps``, or ``error`` where a codec has no weights or no exported encoder; and provenance.

    Raises:
        ConfigError: A codec is none there is, or not a learned one: neither runtime nor instruction set
            makes it another.
        SemcastError: No variant ran.
    """
    for name in settings.codecs:
        if name in LEARNED_CODECS:
            continue
        check_codec(name)
        if name in available_codecs():
            raise ConfigError(f"codec must be a learned one, got {name!r}, which has no runtime to choose")
    children: list[_Child] = []
    finished: list[int] = []
    try:
        for variant in variants(settings, cpu_flags()):
            children.append(_Child(variant, (settings.height, settings.width)))
        with until_interrupted(finished) as part:
            for k in range(settings.rounds):
                for child in children:
                    child.turn(settings.calls)
                finished.append(k)
    finally:
        for child in children:
            child.close()
    if not any(child.times_ms for child in children):
        raise SemcastError(f"no variant ran: {children[0].error}")
    report = {"results": [_row(child) for child in children], **provenance(VERB, settings)}
    return write_result(settings.json, report, part)


def _row(child: _Child) -> dict[str, Any]:
    row: dict[str, Any] = {**asdict(child.variant), "p50_ms": None, "p95_ms": None, "fps": None}
    row["precision"] = child.precision
    if child.times_ms:
        p50, p95 = np.percentile(child.times_ms, [50, 95])
        row |= {"p50_ms": float(p50), "p95_ms": float(p95), "fps": 1000.0 / float(p50)}
    if child.error is not None:
        row["error"] = child.error
    return row
