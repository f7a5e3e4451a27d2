"""Tables of path errors for ``docs/results.md`` and the README: medians over seeds, and what they would hide.

The median of three runs is the same whether the third is a little worse or has lost its way. So the worst run
stands beside it where it is clearly worse; of the shares of frames with a pose the least one counts, of the
numbers of parts of the map the largest.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import number, table
from semcast.evaluation.pipeline import CLEAN
from semcast.evaluation.report import result_files
from semcast.evaluation.trace_snr import level_name

Report = Mapping[str, Any]
#: The worst run is told where its error is more than so many times the median. Runs of one cell that went
#: alike mostly lie within it.
WORST_RATIO = 1.5
#: Channel and SNR in dB, or clean images, to the column of the README's table.
README_LINKS: dict[tuple[str, float] | None, str] = {
    None: "clean images",
    ("rayleigh", 6.0): "fading, 6 dB",
    ("rayleigh", 2.0): "fading, 2 dB",
    ("erasure", 6.0): "one slot in five lost, 6 dB",
    ("awgn", 2.0): "noise, 2 dB",
}
#: A recording that was sent over this link alone has no row.
_POOR_LINK = ("rayleigh", 2.0)
#: Link of which the table also has the errors of poses as they were published, and the name of that column.
_LIVE_LINK, _LIVE = ("rayleigh", 6.0), "the same, live"


def median_and_worst(cell: Report, figure: str = "ate_percent", digits: int = 2) -> str:
    """Return the median of an error over the runs of a cell as text.

    In brackets stands the worst run where its error is over ``WORST_RATIO`` times the median, or how many
    runs have no path at all.

    Args:
        cell: One of the ``cells`` of ``evaluate_trajectory``.
        figure: Name of the error in the cell and in its runs.
        digits: After the point.
    """
    median = cell[figure]
    found = [run[figure] for run in cell["runs"]]
    if None in found:
        return f"{number(median, digits)} ({found.count(None)} of {len(found)} without a path)"
    worst = max(found)
    return number(median, digits) + (f" ({number(worst, digits)})" if worst > WORST_RATIO * median else "")


def least_completeness(cell: Report, figure: str = "completeness") -> float:
    """Return the least share of frames with a pose among the runs of a cell."""
    return min(float(run[figure]) for run in cell["runs"])


def most_parts(cell: Report) -> int:
    """Return into how many parts the map fell in the run in which these are the most."""
    return max(len(run["parts"]) for run in cell["runs"])


def trajectory_table(report: Report) -> Iterator[str]:
    """Yield the lines of the table of a result of ``semcast eval trajectory``.

    Figures of the poses as they were published, how their errors compare with their covariances, and the time
    after a gap have columns where the file has them; parts of the map where there is more than one.
    """
    cells = report["cells"]
    is_live = any("ate_at_once_percent" in cell for cell in cells)
    says_how_sure = any(cell.get("stated_ratio_trans") is not None for cell in cells)
    in_parts = any(most_parts(cell) > 1 for cell in cells)
    gap_s = report["settings"].get("gap_s")
    if gap_s:
        yield f"Nothing arrives for {gap_s:g} s, at another place for each seed. `again`: from the first"
        yield "frame after that to the first with a pose.\n"
    head = ["SNR dB", "confidence", "ATE m", "ATE %", "least completeness"]
    head += ["live ATE %", "least completeness, live"] if is_live else []
    head += ["live error / stated sigma: place, turn"] if says_how_sure else []
    head += ["most parts"] if in_parts else []
    head += ["RPE %", "RPE deg", "PSNR dB", "seeds", *(["again s"] if gap_s else [])]
    yield from table(
        head,
        [
            [
                level_name(cell["snr_db"], report),
                cell["confidence"],
                number(cell["ate_rmse_m"], 3),
                median_and_worst(cell, digits=3),
                number(least_completeness(cell), 3),
                *(_live(cell) if is_live else []),
                *([_stated(cell)] if says_how_sure else []),
                *([str(most_parts(cell))] if in_parts else []),
                number(cell["rpe_trans_percent"]),
                number(cell["rpe_rot_deg"], 3),
                number(cell["psnr_db"]),
                str(len(cell["seeds"])),
                *([number(cell["recovery_s"])] if gap_s else []),
            ]
            for cell in cells
        ],
    )


def _live(cell: Report) -> list[str]:
    if "ate_at_once_percent" not in cell:
        return ["-", "-"]
    posed = least_completeness(cell, "completeness_at_once")
    return [median_and_worst(cell, "ate_at_once_percent", 3), number(posed, 3)]


def _stated(cell: Report) -> str:
    ratios = cell.get("stated_ratio_trans"), cell.get("stated_ratio_rot")
    return ", ".join(number(ratio, 1) for ratio in ratios)


def readme_table(folder: Path) -> str:
    """Return the README's short table: path errors in the default mode, recordings by links.

    Recordings that were sent over most links come first. Those with a gap, Doppler or another codec are not
    in it, nor those that were sent over the poor link alone: they are there for what confidence is worth.
    """
    errors: dict[str, dict[str, str]] = {}
    live: dict[str, str] = {}
    for file in result_files(folder, "trajectory_*.json"):
        report = json.loads(file.read_text(encoding="utf-8"))
        channel = report["settings"]["link"]["channel"]
        # The SNR of a trace is but its start, and fading with Doppler is another link than without.
        is_other = channel == "trace" or report["settings"]["link"].get("doppler_hz")
        if is_other or report["settings"].get("gap_s"):
            continue
        if report["settings"]["codec"] not in (CLEAN, DEFAULT_CODEC):
            continue
        for cell in report["cells"]:
            link = None if cell["snr_db"] is None else (channel, cell["snr_db"])
            if cell["confidence"] == "robust" and link in README_LINKS:
                posed = least_completeness(cell)
                # Rounded down: a share that is not all of them must not read 100.0%.
                share = "" if posed == 1.0 else f", {int(1000 * posed) / 10:.1f}% posed"
                of = errors.setdefault(report["sequence"], {})
                parts = f", {num} parts" if (num := most_parts(cell)) > 1 else ""
                of[README_LINKS[link]] = median_and_worst(cell) + share + parts
                if link == _LIVE_LINK and "ate_at_once_percent" in cell:
                    live[report["sequence"]] = median_and_worst(cell, "ate_at_once_percent")
    links = list(README_LINKS.values())
    shown = [(name, of) for name, of in errors.items() if set(of) != {README_LINKS[_POOR_LINK]}]
    ordered = sorted(shown, key=lambda entry: (-len(entry[1]), entry[0]))
    for name, of in ordered:
        of[_LIVE] = live.get(name, "-")
    links.insert(links.index(README_LINKS[_LIVE_LINK]) + 1, _LIVE)
    rows = [[name, *(of.get(link, "-") for link in links)] for name, of in ordered]
    return "\n".join(table(("recording", *links), rows))
