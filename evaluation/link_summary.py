"""What confidence does to paths, link by link over all recordings: another part of ``docs/confidence.md``.

A row of one recording tells mostly chance. Over many recordings it averages out, and what is left tells where
confidence is worth something. A recording counts once, however many runs it has: runs over one recording
share its views, and are alike for that.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import table
from semcast.evaluation.statistics import MIN_SAMPLES, scatter_of_mean
from semcast.evaluation.trajectory_summary import LEAST_PERCENT, paired_runs

Array = NDArray[np.float64]
Report = Mapping[str, Any]

#: Runs of a recording over one link from which it counts.
_MIN_RUNS = 3
_SEED = 0


@dataclass(frozen=True)
class LinkComparison:
    """How errors with confidence compare with those without over one kind of link.

    Attributes:
        channel: Name of the channel.
        snr_db: Of the link.
        num_runs: Runs of each mode.
        log_ratios: ``(N,)`` of each recording, the mean over its runs of the logarithm of the errors' ratio:
            of the path after the last correction.
        log_ratios_live: ``(N,)`` the same of poses as they were published.
    """

    channel: str
    snr_db: float
    num_runs: int
    log_ratios: Array
    log_ratios_live: Array


def compare_links(reports: Iterable[Report]) -> list[LinkComparison]:
    """Compare the modes ``robust`` and ``off`` over links that at least five recordings were sent over.

    Args:
        reports: Results of ``semcast eval trajectory``. Those of other codecs than the default one, with gaps
            or Doppler are left out, and recordings with fewer than three runs of both modes.

    Returns:
        By channel, then SNR.
    """
    found: dict[tuple[str, float], list[tuple[int, float, float]]] = {}
    for report in reports:
        settings = report["settings"]
        is_other = settings["codec"] != DEFAULT_CODEC or settings.get("gap_s")
        if is_other or settings["link"].get("doppler_hz"):
            continue
        for snr_db, shared in paired_runs(report):
            live = _log_ratios(shared, "ate_at_once_percent")
            final = _log_ratios(shared, "ate_percent")
            if min(len(live), len(final)) >= _MIN_RUNS:
                of_link = found.setdefault((settings["link"]["channel"], snr_db), [])
                of_link.append((len(final), float(np.mean(final)), float(np.mean(live))))
    return [
        LinkComparison(*link, sum(r[0] for r in rows), *(np.array([r[k] for r in rows]) for k in (1, 2)))
        for link, rows in sorted(found.items())
        if len(rows) >= MIN_SAMPLES
    ]


def link_summary(reports: Iterable[Report]) -> str:
    """Return the table as Markdown, empty without a link over which enough recordings were sent."""
    links = compare_links(reports)
    return "\n".join(_lines(links)) + "\n" if links else ""


def _lines(links: Sequence[LinkComparison]) -> Iterator[str]:
    yield "Geometric mean over recordings of the error with confidence over that without, and its 95 %"
    yield "interval over recordings: of the path in the end, and of poses as they were published.\n"
    yield from table(
        ("link", "recordings", "runs", "path in the end", "live"),
        [
            (
                f"{link.channel}, {link.snr_db:g} dB",
                len(link.log_ratios),
                link.num_runs,
                _with_interval(link.log_ratios),
                _with_interval(link.log_ratios_live),
            )
            for link in links
        ],
    )


def _with_interval(log_ratios: Array) -> str:
    mean = log_ratios.mean()
    off = scatter_of_mean(log_ratios, np.random.default_rng(_SEED))
    low, high = np.exp(mean + np.percentile(off, [2.5, 97.5]))
    return f"{np.exp(mean):.2f} ({low:.2f} .. {high:.2f})"


def _log_ratios(shared: Sequence[tuple[Report, Report]], figure: str) -> Array:
    both = [(ours.get(figure), theirs.get(figure)) for ours, theirs in shared]
    known = np.array([pair for pair in both if None not in pair], dtype=np.float64).reshape(-1, 2)
    return np.asarray(-np.diff(np.log(np.maximum(known, LEAST_PERCENT)), axis=1).ravel())
