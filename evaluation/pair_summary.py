"""What the pair benchmark says in a few tables: the part of ``docs/confidence.md`` between its markers.

A cell is one recording, channel, SNR, gap, kind of features and thinning. Ratios of cells are averaged
geometrically, so that no hard cell outweighs all others.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import number, table

#: The best confidence-free estimator of others on these matches.
RIVAL = "poselib"
#: What people use without a thought.
PLAIN = "opencv_ransac"
#: The paper's estimator with equal confidence.
UNWEIGHTED_PAPER = "plain_ransac"
_AGAINST_PLAIN = ("plain_ransac", "paper", "robust")
#: The paper's claim is about links this bad.
BAD_LINK_DB = 6.0
_METHODS = ("plain_ransac", "opencv_ransac", "opencv_magsac", "poselib", "paper", "off", "robust", "oracle")
#: A cell is hard over a bad link where both estimators are so far off.
_HARD_DEG = 3.0
_MISLEADING = ("constant", "shuffled", "inverted")


@dataclass(frozen=True)
class Cell:
    """One cell and where it comes from."""

    recording: str
    channel: str
    codec: str
    values: Mapping[str, Any]

    @property
    def link(self) -> str:
        """Channel, and codec where it is not the default."""
        codec = "" if self.codec == DEFAULT_CODEC else f", {self.codec}"
        return f"{self.channel}{codec}"

    @property
    def matches(self) -> str:
        """How many matches the estimators got."""
        most = self.values["max_matches"]
        return f"{most} matches" if most else "all matches"

    def mean(self, method: str, figure: str = "tdir_deg_mean") -> float | None:
        """Return a figure of one method, None where it was not run."""
        value = self.values["results"].get(method, {}).get(figure)
        return None if value is None else float(value)

    def interval(self, mode: str, against: str, figure: str = "tdir_deg_mean") -> Mapping[str, Any] | None:
        """Return the paired comparison of a mode to a rival."""
        wanted = {"mode": mode, "against": against, "figure": figure}
        for comparison in self.values["comparisons"]:
            if wanted.items() <= comparison.items():
                paired: Mapping[str, Any] | None = comparison["paired"]
                return paired
        return None


def is_silent(cell: Cell) -> bool:
    """Whether most pairs of images were lost: all methods are then 90 degrees off, which compares nothing."""
    num_pairs = max(int(result["num_pairs"]) for result in cell.values["results"].values())
    return 2 * int(cell.values["num_pairs_lost"]) > num_pairs


def cells_of(reports: Iterable[Mapping[str, Any]]) -> list[Cell]:
    """Return all cells of reports of ``semcast eval pairs``; those without a link are left out."""
    return [
        Cell(report["sequence"], report["settings"]["link"]["channel"], report["settings"]["codec"], values)
        for report in reports
        for values in report["cells"]
        if values["snr_db"] is not None
    ]


def pair_summary(reports: Iterable[Mapping[str, Any]]) -> str:
    """Return the tables as Markdown.

    Args:
        reports: Results of ``semcast eval pairs`` with all modes and competitors.
    """
    every = cells_of(reports)
    cells = [c for c in every if not is_silent(c)]
    if not cells:
        return ""
    parts = [
        _left_out(len(every) - len(cells)),
        _against_rival(cells),
        _against_plain(cells),
        _misleading(cells),
        _cues(cells),
        _time(cells),
    ]
    return "\n".join(line for part in parts for line in (*part, ""))


def _left_out(num_silent: int) -> Iterator[str]:
    silent = f" Left out: {num_silent} cell(s) in which most pairs were lost." if num_silent else ""
    yield "A pair of which an image was lost, or for which nothing was found, counts as 90 degrees, in"
    yield f"rotation and in direction.{silent}"


def _against_rival(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**Mean translation-direction error in degrees**, mean over the cells of a row, each in four rows."
    yield "`better` and `worse` count those in which the 95 % interval of `robust` minus"
    yield f"`{RIVAL}` excludes zero.\n"
    rows = []
    for title, group in _groups(cells):
        figures = [number(_mean(c.mean(m) for c in group), 1) for m in _METHODS]
        paired = [p for c in group if (p := c.interval("robust", RIVAL)) is not None]
        paired = [p for p in paired if p["low"] is not None]
        better = sum(p["high"] < 0 for p in paired)
        worse = sum(p["low"] > 0 for p in paired)
        ratio = number(_ratio(group, "robust", RIVAL))
        rows.append([title, str(len(group)), *figures, ratio, str(better), str(worse)])
    head = ["cells of", "number", *_METHODS, f"robust / {RIVAL}", "better", "worse"]
    yield from table(head, rows)
    yield ""
    yield (
        f"Over all {len(cells)} cells `robust` has {_ratio(cells, 'robust', RIVAL):.2f} times the error of "
        f"`{RIVAL}` and {_ratio(cells, 'robust', 'off'):.2f} times that of `off`; `paper` has "
        f"{_ratio(cells, 'paper', UNWEIGHTED_PAPER):.2f} times that of `{UNWEIGHTED_PAPER}`."
    )
    hard = [c for c in cells if _is_hard(c)]
    if hard and all(c.mean("oracle") is not None for c in hard):
        ours, theirs, best = (_mean(c.mean(m) for c in hard) for m in ("robust", RIVAL, "oracle"))
        yield (
            f"In the {len(hard)} hard cells ({BAD_LINK_DB:g} dB and below, both {_HARD_DEG:g} degrees and "
            f"more off) it has {_ratio(hard, 'robust', RIVAL):.2f} times the error of `{RIVAL}`, and "
            f"`{RIVAL}` itself on the true inliers alone has {_ratio(hard, 'oracle', RIVAL):.2f} times it "
            f"(`oracle`; means {number(ours, 1)}, {number(theirs, 1)} and {number(best, 1)} degrees)."
        )


def _is_hard(cell: Cell) -> bool:
    # By the mean of both: chosen by one of them, its own luck would speak for the other.
    both = [cell.mean("robust"), cell.mean(RIVAL)]
    mean = _mean(both)
    return float(cell.values["snr_db"]) <= BAD_LINK_DB and mean is not None and mean >= _HARD_DEG


def _against_plain(cells: Sequence[Cell]) -> Iterator[str]:
    bad = [c for c in cells if float(c.values["snr_db"]) <= BAD_LINK_DB]
    if not bad:
        return
    yield f"**Gain over plain RANSAC (OpenCV's) at {BAD_LINK_DB:g} dB and below**, in degrees of the mean"
    yield "error; the paper claims 1-2 of rotation and 8-10 of translation direction.\n"
    rows = []
    for title, group in _groups(bad):
        row = [title, str(len(group))]
        for figure in ("rot_deg_mean", "tdir_deg_mean"):
            plain = _mean(c.mean(PLAIN, figure) for c in group)
            row.append(number(plain, 1))
            for method in _AGAINST_PLAIN:
                ours = _mean(c.mean(method, figure) for c in group)
                row.append("-" if plain is None or ours is None else f"{plain - ours:+.1f}")
        rows.append(row)
    names = ("plain", *_AGAINST_PLAIN)
    figures = (f"{figure}, {name}" for figure in ("rotation", "direction") for name in names)
    head = ["cells of", "number", *figures]
    yield from table(head, rows)
    yield ""
    for method in ("paper", "robust"):
        rot, tdir = (_median_gain(bad, method, f"{figure}_deg_mean") for figure in ("rot", "tdir"))
        yield f"`{method}`: {rot:+.1f} of rotation and {tdir:+.1f} of direction in the median of the cells.\n"
    yield f"`{UNWEIGHTED_PAPER}` and `paper` measure matches by the algebraic residual of the paper's Eq. 18."
    yield "It is smaller the nearer a match is to an epipole: a motion along the optical axis, which puts the"
    yield "epipole among the matches, gets the most inliers, whatever the camera did. Where it moved sideways"
    yield "that costs both far more than confidence changes."


def _median_gain(cells: Sequence[Cell], method: str, figure: str) -> float:
    gains = [
        plain - ours
        for c in cells
        if (plain := c.mean(PLAIN, figure)) is not None and (ours := c.mean(method, figure)) is not None
    ]
    return float(np.median(gains)) if gains else float("nan")


def _misleading(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**What a misleading confidence costs**: AUC@10 in points minus that of `off`, mean and worst.\n"
    rows = []
    for mode in ("robust", *_MISLEADING):
        gaps = [
            a - b
            for c in cells
            if (a := c.mean(mode, "auc10")) is not None and (b := c.mean("off", "auc10")) is not None
        ]
        if gaps:
            rows.append([mode, f"{np.mean(gaps):+.1f}", f"{min(gaps):+.1f}"])
    yield from table(["confidence", "mean", "worst"], rows)


def _cues(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**How well each cue tells true inliers** (AUROC, mean over cells; 0.5 says nothing). `epipolar`:"
    yield "within 2 px of the true epipolar line; `track`: of where the originals put the point.\n"
    found: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for c in cells:
        for kind, cues in c.values["auroc"].items():
            for cue, value in cues.items():
                if value is not None:
                    found[kind, c.values["features"], cue].append(float(value))
    kinds = sorted({(kind, features) for kind, features, _ in found})
    rows = [
        [cue, *(number(_mean(found.get((*kind, cue), ()))) for kind in kinds)]
        for cue in sorted({cue for _, _, cue in found})
    ]
    yield from table(["cue", *(f"{kind}, {features}" for kind, features in kinds)], rows)


def _time(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**Processor time of one estimation** in ms, median over cells of the medians, all matches.\n"
    whole = [c for c in cells if not c.values["max_matches"]]
    names = [name for name in _METHODS if any(name in c.values["results"] for c in whole)]
    medians = [
        [
            t["p50"]
            for c in whole
            if (t := c.values["results"].get(name, {}).get("cpu_ms")) and t["p50"] is not None
        ]
        for name in names
    ]
    yield from table(names, [[number(float(np.median(m)), 1) if m else "-" for m in medians]])


def _groups(cells: Sequence[Cell]) -> Iterator[tuple[str, list[Cell]]]:
    """Yield the rows of a table: by recording and features, then by link, by number of matches, and all."""
    keys: tuple[Callable[[Cell], str], ...] = (
        lambda c: f"{c.recording}; {c.values['features']}",
        lambda c: c.link,
        lambda c: c.matches,
        lambda c: "all",
    )
    for key in keys:
        groups: dict[str, list[Cell]] = defaultdict(list)
        for cell in cells:
            groups[key(cell)].append(cell)
        yield from groups.items()


def _mean(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def _ratio(cells: Iterable[Cell], ours: str, theirs: str) -> float:
    """Geometric mean of the ratios of mean translation-direction errors; NaN without any."""
    pairs = [(c.mean(ours), c.mean(theirs)) for c in cells]
    logs = [np.log(a / b) for a, b in pairs if a and b]
    return float(np.exp(np.mean(logs))) if logs else float("nan")
