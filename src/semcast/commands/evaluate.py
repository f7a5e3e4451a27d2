"""``semcast eval``: measure on recorded data, in one process and without a network."""

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table

from semcast.commands.running import add_settings, read_settings
from semcast.evaluation import codec, confidence, endurance, latency, pairs, recording, runtime, trajectory
from semcast.evaluation.report import check_outputs

_Evaluation = tuple[type, Callable[[Any], dict[str, Any]], frozenset[str], str]
#: what -> settings, function, settings the evaluation sets itself, one line of help
EVALUATIONS: dict[str, _Evaluation] = {
    "trajectory": (
        trajectory.TrajectorySettings,
        trajectory.evaluate_trajectory,
        trajectory.UNUSED_FIELDS,
        "send a recording over the channel, reconstruct it and compare with the true path",
    ),
    "pairs": (
        pairs.PairSettings,
        pairs.evaluate_pairs,
        pairs.UNUSED_FIELDS,
        "relative-pose error of frame pairs, with and without confidence, beside other estimators",
    ),
    "codec": (
        codec.CodecSettings,
        codec.evaluate_codec,
        codec.UNUSED_LINK_FIELDS,
        "image quality of codecs over SNR",
    ),
    "confidence": (
        confidence.ConfidenceSettings,
        confidence.evaluate_confidence,
        confidence.UNUSED_FIELDS,
        "grade the confidence maps of a codec",
    ),
    "latency": (
        latency.LatencySettings,
        latency.evaluate_latency,
        latency.UNUSED_FIELDS,
        "time every stage from encoder to viewer",
    ),
    "endurance": (
        endurance.EnduranceSettings,
        endurance.evaluate_endurance,
        endurance.UNUSED_FIELDS,
        "run for long, a recording back and forth, and watch cost per frame and memory",
    ),
    "runtime": (
        runtime.RuntimeSettings,
        runtime.evaluate_runtime,
        runtime.UNUSED_FIELDS,
        "time encoder and decoder by runtime, instruction set and threads",
    ),
    "recording": (
        recording.RecordingSettings,
        recording.evaluate_recording,
        recording.UNUSED_FIELDS,
        "measure what recording costs beside a stream",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare one sub-verb per evaluation."""
    what = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    for name, (settings, _, skip, text) in EVALUATIONS.items():
        child = what.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        child.add_argument("--debug", action="store_true", help="show tracebacks and debug messages")
        add_settings(child, settings, skip)


def _table(what: str, rows: list[dict[str, Any]]) -> Table:
    """Show the scalar figures that all rows share; per-image and per-frame rows stay in the JSON."""
    columns = [key for key in rows[0] if all(not isinstance(row.get(key), (list, dict)) for row in rows)]
    table = Table(title=f"semcast eval {what}")
    for column in columns:
        table.add_column(column.replace("_", " "), justify="right")
    for row in rows:
        values = (row.get(column) for column in columns)
        table.add_row(*("-" if v is None else f"{v:.3f}" if isinstance(v, float) else str(v) for v in values))
    return table


def _rows(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Find the rows of a report: cells, results (a list or one entry per mode) or stages."""
    for key in ("results", "cells", "stages"):
        value = report.get(key)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return value
        if isinstance(value, dict) and value and all(isinstance(v, dict) for v in value.values()):
            return [{"name": name, **entry} for name, entry in value.items()]
    return []


def run(arguments: argparse.Namespace) -> int:
    """Run one evaluation; a table on stdout, or the whole JSON where no ``--json`` file takes it."""
    cls, evaluate, _, text = EVALUATIONS[arguments.what]
    settings: Any = read_settings(cls, arguments)
    check_outputs(settings.json, getattr(settings, "out", None))
    talk = Console(stderr=True)
    with talk.status(f"{text} ..."):
        report = evaluate(settings)
    rows = _rows(report)
    if settings.json is None:
        print(json.dumps(report, indent=1))
    else:
        if rows:
            Console().print(_table(arguments.what, rows))
        talk.print(f"written to {settings.json}")
    return 0
