"""What confidence does to whole trajectories: another part of ``docs/confidence.md`` between markers.

Runs of two modes under one seed share channel and images. Their errors are compared by ratio: they differ by
factors, and one bad run must not outweigh all others. How bad the worst run is stands beside it.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.evaluation.markdown import number, table, with_interval
from semcast.evaluation.statistics import MIN_SAMPLES, mean_ratio

Array = NDArray[np.float64]
Report = Mapping[str, Any]

#: Least error, in whatever unit: one of exactly 0 has no logarithm.
LEAST_ERROR = 1e-6


@dataclass(frozen=True)
class Pairing:
    """The runs of two modes over the same links.

    Attributes:
        title: Recording, codec, channel and SNR.
        ours_percent: ``(S,)`` ATE in percent of the path of the mode in question.
        theirs_percent: ``(S,)`` of the one it is compared with.
        ours_posed: Mean share of frames with a pose, over all runs.
        theirs_posed: The same.
        num_failed: Runs without a trajectory in either mode; their errors are in no other figure.
    """

    title: str
    ours_percent: Array
    theirs_percent: Array
    ours_posed: float = 1.0
    theirs_posed: float = 1.0
    num_failed: int = 0


def paired_runs(report: Report) -> Iterator[tuple[float, list[tuple[Report, Report]]]]:
    """Yield ``(snr_db, [(robust, off), ...])`` of a report: runs of both modes with one seed, in its order.

    Nothing of one over a trace: its SNR is but its start.
    """
    if report["settings"]["link"]["channel"] == "trace":
        return
    runs: dict[float, dict[str, dict[int, Report]]] = {}
    for cell in report["cells"]:
        if cell["snr_db"] is not None:
            of_mode = {run["seed"]: run for run in cell["runs"]}
            runs.setdefault(cell["snr_db"], {})[cell["confidence"]] = of_mode
    for snr_db, modes in runs.items():
        ours, theirs = modes.get("robust", {}), modes.get("off", {})
        yield snr_db, [(ours[seed], theirs[seed]) for seed in sorted(ours.keys() & theirs.keys())]


def pairings_of(reports: Iterable[Report]) -> list[Pairing]:
    """Return all cells of reports of ``semcast eval trajectory`` that have both modes and enough seeds."""
    found = []
    for report in reports:
        for snr_db, shared in paired_runs(report):
            both = [(a["ate_percent"], b["ate_percent"]) for a, b in shared]
            known = [pair for pair in both if None not in pair]
            if len(known) < MIN_SAMPLES:  # fewer seeds say nothing about bad runs
                continue
            values = np.maximum(np.array(known, dtype=np.float64), LEAST_ERROR)
            settings = report["settings"]
            title = f"{report['sequence']}, {settings['codec']}, {settings['link']['channel']}, {snr_db:g} dB"
            title += f", {gap_s:g} s gap" if (gap_s := settings.get("gap_s")) else ""
            posed = [
                float(np.mean([run["completeness"] for run in runs])) for runs in zip(*shared, strict=True)
            ]
            num_failed = len(both) - len(known)
            found.append(Pairing(title, values[:, 0], values[:, 1], posed[0], posed[1], num_failed))
    return found


def ratio_interval(pairings: Sequence[Pairing]) -> tuple[float, float, float]:
    """Return the geometric mean ratio of errors, all cells alike, and its 95 % bootstrap interval."""
    return mean_ratio([np.log(p.ours_percent / p.theirs_percent) for p in pairings])


def trajectory_summary(reports: Iterable[Report]) -> str:
    """Return the table as Markdown, empty without a cell of enough seeds.

    Args:
        reports: Results of ``semcast eval trajectory`` with the modes ``robust`` and ``off``.
    """
    pairings = pairings_of(reports)
    return "\n".join(_lines(pairings)) + "\n" if pairings else ""


def _lines(pairings: Sequence[Pairing]) -> Iterator[str]:
    yield "ATE in percent of the path; `ratio` is the geometric mean of `robust` over `off`, run by run, with"
    yield "its 95 % interval over seeds.\n"
    rows = []
    for p in pairings:
        sides = ((p.ours_percent, p.ours_posed), (p.theirs_percent, p.theirs_posed))
        figures = [
            text
            for values, posed in sides
            for text in (number(float(np.median(values))), number(float(values.max())), f"{posed:.1%}")
        ]
        rows.append(
            [
                p.title,
                str(len(p.ours_percent)),
                str(p.num_failed),
                *figures,
                with_interval(*ratio_interval([p])),
            ]
        )
    names = (f"{mode}, {what}" for mode in ("robust", "off") for what in ("median", "worst", "posed"))
    head = ["recording, link", "runs", "failed", *names, "ratio"]
    yield from table(head, rows)
    yield f"\nOver all {len(pairings)} rows: {with_interval(*ratio_interval(pairings))}."
