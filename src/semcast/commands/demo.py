"""``semcast demo``: the whole system on one machine, ending in a table of figures."""

import argparse
import json
import shlex
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from semcast.channel.emulator import warn_of_settings
from semcast.channel.settings import ChannelSettings
from semcast.commands.console import plain_console
from semcast.commands.running import INTERRUPTED, add_settings, read_settings, run_until_stopped
from semcast.common.codecs import warn_of_modulation
from semcast.common.config_flags import given_values
from semcast.common.metrics import DUPLICATE
from semcast.common.run_folder import FRAMES_NAME, VIEWER_NAME, files_of_run
from semcast.demo import DemoSettings, open_recording, run_demo
from semcast.evaluation.report import STDOUT, provenance, write_result
from semcast.server.export.parts import parts_line
from semcast.server.run_summary import too_much


def _measure(unit: str) -> Callable[[float], str]:
    """Return what writes a value with three digits that count, and its unit."""
    return lambda value: f"{float(f'{value:.3g}'):g} {unit}"


#: Rows of the final table: key of the summary, name, what writes the value.
_FIGURES: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
    ("completeness", "frames with a pose", "{:.1%}".format),
    ("ate_percent", "position error (ATE RMSE after Sim(3))", _measure("% of the path")),
    ("ate_rmse_m", "  in metres", _measure("m")),
    ("rpe_trans_percent", "step error, translation", _measure("%")),
    ("rpe_rot_deg", "step error, rotation", _measure("deg")),
    ("psnr_db", "image quality (PSNR)", "{:.2f} dB".format),
    ("num_landmarks", "landmarks", str),
    ("num_dense_points", "points of the dense cloud", str),
)
#: Share of frames with a pose below which something is wrong with the images rather than with the link.
_FEW = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, DemoSettings)


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Return the figures of a run as a table; what is not known, as errors without a truth, has no row."""
    table = Table(title="what came out", show_header=False, title_justify="left")
    for key, name, written in _FIGURES:
        if (value := summary.get(key)) is not None:
            table.add_row(name, written(value))
    if summary.get("readout_ms"):
        table.add_row("rolling shutter", f"{summary['readout_ms']:.1f} ms from {summary['readout_from']}")
    if line := parts_line(summary.get("parts") or []):
        table.add_row("parts of the map", line)
    for reason, count in (summary.get("drops") or {}).items():
        table.add_row(
            "frames that came twice" if reason == DUPLICATE else f"frames dropped: {reason}", str(count)
        )
    for stage, figures in (summary.get("stage_ms") or {}).items():
        table.add_row(f"{stage}, p50 / p95", f"{figures['p50']:.1f} / {figures['p95']:.1f} ms")
    return table


def why_no_pose(summary: Mapping[str, Any]) -> str:
    """Say in a line what is likely of a run that gave no frame a pose."""
    if busy := too_much(summary):
        return f"no frame has a pose: {busy}"
    if not (summary.get("frames") or {}).get("tracked"):
        return "no frame has a pose, as no image could be decoded"
    return (
        "no frame has a pose: the camera must move sideways and see things with texture, large "
        "enough in the images, and consecutive images must show much the same"
    )


def few_poses(summary: Mapping[str, Any]) -> str | None:
    """Say in a line what is likely of a run in which most frames got no pose; None where they did."""
    share = summary.get("completeness") or 0.0
    if not 0.0 < share < _FEW:
        return None
    if busy := too_much(summary):
        return f"only {share:.0%} of the frames have a pose: {busy}"
    return (
        f"only {share:.0%} of the frames have a pose: are the images those of one moving camera, in the "
        "order in which they were taken? Consecutive ones must show much the same"
    )


def _asked_of_link(settings: DemoSettings, arguments: argparse.Namespace) -> set[str]:
    """Return the names of those values of the link that somebody asked for: a demo.toml holds them all."""
    typed = given_values(DemoSettings, arguments).get("link", {})
    link, usual = asdict(settings.link), asdict(ChannelSettings())
    return {*typed, *(name for name in link if link[name] != usual[name])}


def run(arguments: argparse.Namespace) -> int:
    """Run the demo; exit code 1 when no frame got a pose.

    With ``--json -`` the summary has stdout for itself.
    """
    settings = read_settings(DemoSettings, arguments)
    warn_of_settings(settings.link, _asked_of_link(settings, arguments))
    warn_of_modulation(settings.codec, given_values(DemoSettings, arguments))
    json_to_stdout = settings.json == STDOUT
    if json_to_stdout:
        settings = replace(settings, json=None)
    talk = plain_console(stderr=True)
    recorded = open_recording(settings)
    result: dict[str, Any] = {}
    failures: list[str] = []

    def work(stop: threading.Event) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=talk) as bar:
            task = bar.add_task("starting server, channel and agent", total=recorded.num_frames)

            def show(num_done: int, text: str) -> None:
                bar.update(task, completed=num_done, description=text)

            summary, error = run_demo(
                settings, recorded, stop, lambda line: talk.print(line, soft_wrap=True), show
            )
            result.update(summary or {})
            if error is not None:
                failures.append(error)

    code = run_until_stopped(work)
    if failures:
        talk.print(failures[0], soft_wrap=True)
        code = code or 1
    if not result:
        # A server that had frames writes a summary, unless it was killed.
        if code == INTERRUPTED and not failures and not (settings.out / FRAMES_NAME).exists():
            talk.print("stopped before the first frame was tracked: there are no results")
        else:
            logs = settings.out / "logs"
            talk.print(
                f"no summary was written; the logs of the three processes say why: {logs}", soft_wrap=True
            )
        return code or 1
    shown = talk if json_to_stdout else plain_console()
    shown.print(summary_table(result))
    there = ", ".join(file.name for file in files_of_run(settings.out))
    shown_file = settings.out / VIEWER_NAME
    show_again = shlex.join(("rerun", str(shown_file)))
    again = f"; look again with: {show_again}" if shown_file.exists() else ""
    shown.print(f"in {settings.out}: {there}{again}", soft_wrap=True)
    # The demo's own settings in place of the server's, which name folders of this machine.
    report = {**result, **provenance("demo", settings)}
    if json_to_stdout:
        print(json.dumps(report, indent=1))
    else:
        write_result(settings.json, report)
    if not code and not result.get("completeness"):
        talk.print(f"semcast demo: {why_no_pose(result)}", soft_wrap=True)
        return 1
    if not code and (words := few_poses(result) or too_much(result)):
        talk.print(f"semcast demo: {words}", soft_wrap=True)
    return code
