"""``semcast eval``: measure on recorded data."""

import argparse
import json
import logging
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from semcast.channel.emulator import warn_of_settings
from semcast.channel.link import Link
from semcast.commands.console import plain_console
from semcast.commands.running import INTERRUPTED, add_settings, read_given, read_settings
from semcast.common.codecs import warn_of_modulation
from semcast.evaluation import (
    codec,
    confidence,
    depth,
    endurance,
    latency,
    pairs,
    recording,
    runtime,
    server,
    trajectory,
)
from semcast.evaluation.interruption import InterruptedMeasurementError, ended_like_ctrl_c
from semcast.evaluation.pipeline import CLEAN
from semcast.evaluation.report import RESULT_NAME, STDOUT, UnwrittenResultError, check_outputs
from semcast.evaluation.result_table import ResultTable, result_table

logger = logging.getLogger(__name__)

#: What is said of a codec and of the link that carries its symbols, besides the channel.
_OF_A_CODEC = ("snr_db", "modulation", "precision")

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
        codec.UNUSED_FIELDS,
        "image quality of codecs over SNR",
    ),
    "confidence": (
        confidence.ConfidenceSettings,
        confidence.evaluate_confidence,
        confidence.UNUSED_FIELDS,
        "grade the confidence maps of a codec",
    ),
    "depth": (
        depth.DepthSettings,
        depth.evaluate_depth,
        depth.UNUSED_FIELDS,
        "depth maps from decoded images, beside exact ones or those of the originals",
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
    "server": (
        server.ServerRunSettings,
        server.evaluate_server,
        server.UNUSED_FIELDS,
        "play a recorded stream to a live server alone and time its frames",
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


def printed_table(what: str, table: ResultTable) -> Table:
    """Return a table that shows every name of a column whole; names in its cells may take several lines."""
    printed = Table(
        title=f"semcast eval {what}",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for name in table.head:
        printed.add_column(Text(name), justify="right", min_width=len(name), overflow="fold")
    for row in table.rows:
        printed.add_row(*(Text(cell) for cell in row))
    return printed


def _write_times_ns(folder: Path | None) -> dict[Path, int]:
    """Return when each file of a folder was written last, in the order of their names."""
    if folder is None:
        return {}
    return {path: path.stat().st_mtime_ns for path in sorted(folder.iterdir()) if path.is_file()}


def run(arguments: argparse.Namespace) -> int:
    """Run one evaluation: a table on stdout, the names of the files it wrote on stderr.

    The JSON goes to the file of ``--json``, else to ``result.json`` in the folder of ``--out``. With
    ``--json -`` it has stdout for itself and the table goes to stderr. A run that a signal ends leaves
    what was finished.
    """
    cls, evaluate, _, text = EVALUATIONS[arguments.what]
    settings: Any = read_settings(cls, arguments)
    out: Path | None = getattr(settings, "out", None)
    talk = plain_console(stderr=True)
    json_to_stdout = settings.json == STDOUT
    if json_to_stdout:
        settings = replace(settings, json=None)
    elif settings.json is None and out is not None:
        settings = replace(settings, json=out / RESULT_NAME)
    check_outputs(settings.json, out)
    given = read_given(cls, arguments)
    _check_link(settings, given)
    warn_of_modulation(getattr(settings, "codec", None) or (), given)
    if settings.json is None and not json_to_stdout and _input_exists(settings):
        _tell("only the table will be left of this run: --json FILE keeps all figures")
    before_ns = _write_times_ns(out)
    unwritten: UnwrittenResultError | None = None
    json_file: Path | None = settings.json
    with talk.status(f"{text} ..."), ended_like_ctrl_c():
        try:
            report = evaluate(settings)
        except UnwrittenResultError as err:
            report, unwritten = err.result, err
        except InterruptedMeasurementError as cut:
            report, json_file = cut.result, cut.path
    table = result_table(arguments.what, report)
    (talk if json_to_stdout else plain_console()).print(
        printed_table(arguments.what, table), *table.notes, sep="\n"
    )
    if unwritten is not None:
        raise unwritten
    if json_to_stdout:
        print(json.dumps(report, indent=1))
    written = [path for path, time_ns in _write_times_ns(out).items() if before_ns.get(path) != time_ns]
    if json_file is not None and json_file not in written:
        written.append(json_file)
    for path in written:
        _tell(f"written: {path}")
    return INTERRUPTED if report.get("partial") else 0


def _input_exists(settings: Any) -> bool:
    """Whether what is to be measured is there; if it is not, that is all there is to say."""
    inputs = (getattr(settings, name, None) for name in ("sequence", "images", "file"))
    return all(path is None or os.path.exists(path) for path in inputs)


def _check_link(settings: Any, given: Mapping[str, Any]) -> None:
    """Refuse a trace that can't be read; say which of the given values do nothing, SNRs beside one too."""
    if not hasattr(settings, "link"):
        return
    Link(settings.link, seed=0)
    if getattr(settings, "codec", None) != CLEAN:
        warn_of_settings(settings.link, {*given.get("link", {}), *given})
    elif idle := [*given.get("link", {}), *(name for name in _OF_A_CODEC if name in given)]:
        logger.warning("%s: no effect with codec %s, which sends nothing", ", ".join(idle), CLEAN)


def _tell(line: str) -> None:
    """Say a line that is not part of the result; a console of rich would break long paths."""
    print(line, file=sys.stderr)
