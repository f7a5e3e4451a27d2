"""What confidence does to paths, link by link over all recordings: another part of ``docs/confidence.md``.

A row of one recording tells mostly chance. Over many recordings it averages out, and what is left tells where
confidence is worth something. A recording counts once, however many runs and files it has: runs over one
recording share its views, and are alike for that.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import table, with_interval
from semcast.evaluation.statistics import MIN_SAMPLES, mean_ratio
from semcast.evaluation.trajectory_summary import LEAST_ERROR, paired_runs

Array = NDArray[np.float64]
Report = Mapping[str, Any]

#: Errors of a run, and how the table calls them: of all of the path, after the last correction and as it was
#: published, and of the motion from one frame to the next.
FIGURES = {
    "ate_percent": "path in the end",
    "ate_at_once_percent": "path, live",
    "rpe_trans_percent": "way from frame to frame",
    "rpe_rot_deg": "turn from frame to frame",
}
#: Runs of a recording over one link from which it counts.
_MIN_RUNS = 3


@dataclass(frozen=True)
class LinkComparison:
    """How errors with confidence compare with those without over one kind of link.

    Attributes:
        channel: Name of the channel.
        snr_db: Of the link.
        num_runs: Runs of each mode.
        log_ratios: ``(N, 4)`` of each recording, the mean over its runs of the logarithm of the ratio of each
            of ``FIGURES``.
    """

    channel: str
    snr_db: float
    num_runs: int
    log_ratios: Array


def compare_links(reports: Iterable[Report]) -> list[LinkComparison]:
    """Compare the modes ``robust`` and ``off`` over links that at least five recordings were sent over.

    Args:
        reports: Results of ``semcast eval trajectory``. Those of other codecs than the default one, with gaps
            or Doppler are left out, and recordings with fewer than three runs of both modes.

    Returns:
        By channel, then SNR.
    """
    found: dict[tuple[str, float], dict[str, list[Array]]] = {}
    for report in reports:
        settings = report["settings"]
        is_other = settings["codec"] != DEFAULT_CODEC or settings.get("gap_s")
        if is_other or settings["link"].get("doppler_hz"):
            continue
        for snr_db, shared in paired_runs(report):
            of_link = found.setdefault((settings["link"]["channel"], snr_db), {})
            of_link.setdefault(report["sequence"], []).append(log_ratios(shared))
    compared = []
    for (channel, snr_db), of_link in sorted(found.items()):
        runs = [np.concatenate(logs) for logs in of_link.values()]
        runs = [logs for logs in runs if len(logs) >= _MIN_RUNS]
        if len(runs) >= MIN_SAMPLES:
            means = np.stack([logs.mean(axis=0) for logs in runs])
            compared.append(LinkComparison(channel, snr_db, sum(map(len, runs)), means))
    return compared


def link_summary(reports: Iterable[Report]) -> str:
    """Return the table as Markdown, empty without a link over which enough recordings were sent."""
    links = compare_links(reports)
    return "\n".join(_lines(links)) + "\n" if links else ""


def _lines(links: Sequence[LinkComparison]) -> Iterator[str]:
    yield "Geometric mean over recordings of the error with confidence over that without, and its 95 %"
    yield "interval over recordings.\n"
    yield from table(
        ("link", "recordings", "runs", *FIGURES.values()),
        [
            (
                f"{link.channel}, {link.snr_db:g} dB",
                len(link.log_ratios),
                link.num_runs,
                *(with_interval(*mean_ratio([logs])) for logs in link.log_ratios.T),
            )
            for link in links
        ],
    )


def log_ratios(shared: Sequence[tuple[Report, Report]]) -> Array:
    """Return logarithms ``(R, 4)`` of the ratios of ``FIGURES``, of runs that have all of them in both."""
    both = np.array(
        [[[run.get(figure) for figure in FIGURES] for run in runs] for runs in shared], dtype=np.float64
    ).reshape(-1, 2, len(FIGURES))
    known = both[np.isfinite(both).all(axis=(1, 2))]
    ours, theirs = np.log(np.maximum(known, LEAST_ERROR)).transpose(1, 0, 2)
    return np.asarray(ours - theirs)
