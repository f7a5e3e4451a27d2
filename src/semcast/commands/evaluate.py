"""``semcast eval``: measure on recorded data, in one process and without a network."""

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table

from semcast.commands.running import add_settings, read_settings
from semcast.evaluation.codec import CodecSettings, evaluate_codec
from semcast.evaluation.confidence import ConfidenceSettings, evaluate_confidence
from semcast.evaluation.latency import LatencySettings, evaluate_latency
from semcast.evaluation.pairs import PairSettings, evaluate_pairs
from semcast.evaluation.pipeline import UNUSED_LINK_FIELDS
from semcast.evaluation.trajectory import TrajectorySettings, evaluate_trajectory

#: The SNRs and the seed of a run are the evaluation's own settings, not those of the nested parts.
_NESTED = frozenset({"reconstruction.seed"}) | UNUSED_LINK_FIELDS
_WITH_MODES = _NESTED | {"reconstruction.confidence"}

_Evaluation = tuple[type, Callable[[Any], dict[str, Any]], frozenset[str], str]
EVALUATIONS: dict[str, _Evaluation] = {
    "trajectory": (
        TrajectorySettings,
        evaluate_trajectory,
        _WITH_MODES,
        "send a recording over the channel, reconstruct it and compare with the true path",
    ),
    "pairs": (
        PairSettings,
        evaluate_pairs,
        _WITH_MODES,
        "relative-pose error of frame pairs, with and without confidence, beside other estimators",
    ),
    "codec": (CodecSettings, evaluate_codec, _NESTED, "image quality of codecs over SNR"),
    "confidence": (ConfidenceSettings, evaluate_confidence, _NESTED, "grade the confidence maps of a codec"),
    "latency": (LatencySettings, evaluate_latency, _NESTED, "time every stage from encoder to viewer"),
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
    for key in ("cells", "results", "stages"):
        value = report.get(key)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return value
        if isinstance(value, dict) and value and all(isinstance(v, dict) for v in value.values()):
            return [{"name": name, **entry} for name, entry in value.items()]
    return []


def run(arguments: argparse.Namespace) -> int:
    """Run one evaluation; a table on stdout, or the whole JSON where no ``--json`` file takes it."""
    cls, evaluate, _, text = EVALUATIONS[arguments.what]
    settings = read_settings(cls, arguments)
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
