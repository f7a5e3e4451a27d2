"""What confidence does to whole trajectories: another part of ``docs/confidence.md`` between markers.

Runs of two modes under one seed share channel and images. Their errors are compared by ratio: they differ by
factors, and one bad run must not outweigh all others. How bad the worst run is stands beside it.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.evaluation.markdown import number, table

Array = NDArray[np.float64]

#: A cell with fewer seeds says nothing about bad runs.
MIN_SEEDS = 5
_NUM_RESAMPLES = 4000
_SEED = 0


@dataclass(frozen=True)
class Pairing:
    """The runs of two modes over the same links.

    Attributes:
        title: Recording, channel and SNR.
        ours_percent: ``(S,)`` ATE in percent of the path of the mode in question.
        theirs_percent: ``(S,)`` of the one it is compared with.
    """

    title: str
    ours_percent: Array
    theirs_percent: Array


def pairings_of(
    reports: Iterable[Mapping[str, Any]], ours: str = "robust", theirs: str = "off"
) -> list[Pairing]:
    """Return all cells of reports of ``semcast eval trajectory`` that have both modes and enough seeds."""
    found = []
    for report in reports:
        runs: dict[float, dict[str, dict[int, float | None]]] = {}
        for cell in report["cells"]:
            if cell["snr_db"] is not None:
                of_mode = {run["seed"]: run["ate_percent"] for run in cell["runs"]}
                runs.setdefault(cell["snr_db"], {})[cell["confidence"]] = of_mode
        for snr_db, modes in runs.items():
            a, b = modes.get(ours, {}), modes.get(theirs, {})
            both = [(a[s], b[s]) for s in sorted(a) if a[s] is not None and b.get(s) is not None]
            if len(both) >= MIN_SEEDS:
                values = np.array(both, dtype=np.float64)
                link = report["settings"]["link"]["channel"]
                title = f"{report['sequence']}, {link}, {snr_db:g} dB"
                found.append(Pairing(title, values[:, 0], values[:, 1]))
    return found


def ratio_interval(pairings: Sequence[Pairing]) -> tuple[float, float, float]:
    """Return the geometric mean ratio of errors, all cells alike, and its 95 % bootstrap interval."""
    rng = np.random.default_rng(_SEED)
    logs = [np.log(p.ours_percent / p.theirs_percent) for p in pairings]
    drawn = np.zeros(_NUM_RESAMPLES)
    for log in logs:
        drawn += log[rng.integers(len(log), size=(_NUM_RESAMPLES, len(log)))].mean(axis=1) / len(logs)
    low, high = np.exp(np.percentile(drawn, [2.5, 97.5]))
    return float(np.exp(np.mean([log.mean() for log in logs]))), float(low), float(high)


def trajectory_summary(reports: Iterable[Mapping[str, Any]]) -> str:
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
        figures = [
            number(float(f(v)), 2) for v in (p.ours_percent, p.theirs_percent) for f in (np.median, np.max)
        ]
        rows.append([p.title, str(len(p.ours_percent)), *figures, _with_interval([p])])
    head = ["recording, link", "seeds", "robust, median", "worst", "off, median", "worst", "ratio"]
    yield from table(head, rows)
    yield f"\nOver all {len(pairings)} rows: {_with_interval(pairings)}."


def _with_interval(pairings: Sequence[Pairing]) -> str:
    ratio, low, high = ratio_interval(pairings)
    return f"{ratio:.2f} ({low:.2f} .. {high:.2f})"
