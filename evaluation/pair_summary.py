"""What the pair benchmark says in a few tables: the part of ``docs/confidence.md`` between its markers.

A cell is one recording, channel, SNR, gap, kind of features and thinning. Ratios of cells are averaged
geometrically, so that no hard cell outweighs all others.

What confidence gives is the ratio of ``robust`` to ``shuffled``, not to ``off``: that has a search less.
"""

import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import number, table, with_interval
from semcast.evaluation.pair_suite import RECORDINGS
from semcast.evaluation.pipeline import CLEAN
from semcast.evaluation.statistics import MIN_SAMPLES, finite_mean, mean_ratio

Array = NDArray[np.float64]

#: The best confidence-free estimator of others on these matches.
RIVAL = "poselib"
#: What people use without a thought.
PLAIN = "opencv_ransac"
#: The paper's estimator with equal confidence.
UNWEIGHTED_PAPER = "plain_ransac"
_AGAINST_PLAIN = ("paper", RIVAL, "off", "robust")
#: The paper's Fig. 9 and 10: one estimator with confidence, and the same without.
_ALIKE = (("robust", "off"), ("paper", UNWEIGHTED_PAPER))
#: What it gains there at least: degrees of rotation, and of translation direction over links this bad.
_CLAIMED_DEG = {"rot_deg_mean": 1.0, "tdir_deg_mean": 8.0}
BAD_LINK_DB = 6.0
_METHODS = ("plain_ransac", "opencv_ransac", "opencv_magsac", "poselib", "paper", "off", "robust", "oracle")
#: A cell is hard over a bad link where both estimators are so far off.
_HARD_DEG = 3.0
_MISLEADING = ("constant", "shuffled", "inverted")
#: Names that reports give the recordings of ``pair_suite`` which were left out of all tuning.
HELD_OUT = frozenset(Path(recording.path).name for recording in RECORDINGS.values() if recording.held_out)
#: Modes and what they are compared with to tell what confidence gives.
_RATIOS = (
    ("robust", RIVAL),
    ("robust", "off"),
    ("shuffled", "off"),
    ("inverted", "off"),
    ("robust", "shuffled"),
)


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

    def interval(self, mode: str, against: str) -> Mapping[str, Any] | None:
        """Return the paired comparison of a mode's translation direction to a rival's."""
        wanted = {"mode": mode, "against": against, "figure": "tdir_deg_mean"}
        for comparison in self.values["comparisons"]:
            if wanted.items() <= comparison.items():
                paired: Mapping[str, Any] | None = comparison["paired"]
                return paired
        return None


def is_silent(cell: Cell) -> bool:
    """Whether most pairs of images were lost: all methods are then 90 degrees off, which compares nothing."""
    num_pairs = max(int(result["num_pairs"]) for result in cell.values["results"].values())
    return 2 * int(cell.values["num_pairs_lost"]) > num_pairs


def cells_of(reports: Iterable[Mapping[str, Any]], *, clean: bool = False) -> list[Cell]:
    """Return all cells of reports of ``semcast eval pairs``: those behind a link, or of clean images.

    A trace has no SNR that a table could state, and is left out.
    """
    return [
        Cell(report["sequence"], settings["link"]["channel"], settings["codec"], values)
        for report in reports
        if ((settings := report["settings"])["codec"] == CLEAN) == clean
        and (clean or settings["link"]["channel"] != "trace")
        for values in report["cells"]
    ]


def pair_summary(reports: Iterable[Mapping[str, Any]]) -> str:
    """Return the tables as Markdown.

    Args:
        reports: Results of ``semcast eval pairs`` with all modes and competitors.
    """
    reports = list(reports)
    every = cells_of(reports)
    cells = [c for c in every if not is_silent(c)]
    if not cells:
        return ""
    parts = [
        _left_out(len(every) - len(cells)),
        _against_rival(cells),
        _originals(cells_of(reports, clean=True)),
        _what_confidence_gives(cells),
        _with_and_without(cells),
        _against_plain(cells),
        _misleading(cells),
        _cues(cells),
        _time(cells),
    ]
    return "\n".join(line for lines in map(list, parts) if lines for line in (*lines, ""))


def pair_headline(reports: Iterable[Mapping[str, Any]]) -> str:
    """Return what the tables say in a few lines, an entry of a list; empty without cells behind a link."""
    cells = [c for c in cells_of(reports) if not is_silent(c)]
    if not cells:
        return ""
    held_out = [c for c in cells if c.recording in HELD_OUT]
    tracks, matches = (ratio_text(_of_features(cells, f), "robust", "shuffled") for f in ("klt", "sift"))
    rest = (
        f" On the recordings by which no constant was chosen ({len(held_out)} cells) `robust` has "
        f"{_ratio(held_out, 'robust', RIVAL):.2f} times the error of PoseLib, "
        f"{_ratio(held_out, 'robust', 'off'):.2f} that of `off` and "
        f"{_ratio(held_out, 'robust', 'shuffled'):.2f} that of `shuffled` "
        f"({_ratio(_of_features(held_out, 'klt'), 'robust', 'shuffled'):.2f} on tracks)."
    )
    text = (
        f"- Relative poses of frame pairs ({len(cells)} cells): on the same matches `robust` has "
        f"{_ratio(cells, 'robust', RIVAL):.2f} times the error of PoseLib and "
        f"{_ratio(cells, 'robust', 'off'):.2f} times that of `off`. Part of that is not confidence: `robust` "
        "searches once more than `off`. With that search and a shuffled confidence, which says nothing, the "
        f"error is {_ratio(cells, 'shuffled', 'off'):.2f} times that of `off`. What confidence itself gives "
        f"is `robust` against `shuffled`: {tracks} times the error on tracks and {matches} on descriptor "
        "matches (95 % intervals)."
        f"{rest if held_out else ''}"
    )
    return _paragraph(text, subsequent_indent="  ")


def _paragraph(text: str, subsequent_indent: str = "") -> str:
    return textwrap.fill(text, 118, subsequent_indent=subsequent_indent)


def _of_features(cells: Iterable[Cell], features: str) -> list[Cell]:
    return [c for c in cells if c.values["features"] == features]


def _left_out(num_silent: int) -> Iterator[str]:
    silent = f" Left out: {num_silent} cell(s) in which most pairs were lost." if num_silent else ""
    yield "A pair of which an image was lost, or for which nothing was found, counts as 90 degrees, in"
    yield f"rotation and in direction.{silent}"


def _against_rival(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**Mean translation-direction error in degrees**, mean over the cells of a row; each cell counts in"
    yield "four rows: recording and features, link, number of matches, all."
    yield "`better` and `worse` count those in which the 95 % interval of `robust` minus"
    yield f"`{RIVAL}` excludes zero; by chance alone one in forty does on either side.\n"
    rows = []
    for title, group in _groups(cells):
        figures = [number(finite_mean(c.mean(m) for c in group), 1) for m in _METHODS]
        paired = [p for c in group if (p := c.interval("robust", RIVAL)) is not None]
        paired = [p for p in paired if p["low"] is not None]
        better = sum(p["high"] < 0 for p in paired)
        worse = sum(p["low"] > 0 for p in paired)
        ratio = number(_ratio(group, "robust", RIVAL))
        rows.append([title, str(len(group)), *figures, ratio, str(better), str(worse)])
    head = ["cells of", "number", *_METHODS, f"robust / {RIVAL}", "better", "worse"]
    yield from table(head, rows)
    yield ""
    larger = int(np.sum(_log_ratios(cells, "robust", RIVAL) > np.log(1.02)))
    yield _paragraph(
        f"Over all {len(cells)} cells `robust` has {_ratio(cells, 'robust', RIVAL):.2f} times the error of "
        f"`{RIVAL}` and {_ratio(cells, 'robust', 'off'):.2f} times that of `off`; `paper` has "
        f"{_ratio(cells, 'paper', UNWEIGHTED_PAPER):.2f} times that of `{UNWEIGHTED_PAPER}`. In {larger} of "
        f"them `robust` has an error larger than `{RIVAL}`'s by more than 2 %."
    )
    hard = [c for c in cells if _is_hard(c)]
    if hard and all(c.mean("oracle") is not None for c in hard):
        ours, theirs, best = (finite_mean(c.mean(m) for c in hard) for m in ("robust", RIVAL, "oracle"))
        yield _paragraph(
            f"In the {len(hard)} hard cells ({BAD_LINK_DB:g} dB and below, both {_HARD_DEG:g} degrees and "
            f"more off) `robust` has {_ratio(hard, 'robust', RIVAL):.2f} times the error of `{RIVAL}`, and "
            f"`{RIVAL}` on the true inliers alone (`oracle`) {_ratio(hard, 'oracle', RIVAL):.2f} times its "
            f"own; means of `robust`, `{RIVAL}` and `oracle`: {number(ours, 1)}, {number(theirs, 1)} and "
            f"{number(best, 1)} degrees."
        )


def _is_hard(cell: Cell) -> bool:
    # By the mean of both: chosen by one of them, its own luck would speak for the other.
    both = [cell.mean("robust"), cell.mean(RIVAL)]
    mean = finite_mean(both)
    return _is_bad_link(cell) and mean is not None and mean >= _HARD_DEG


def _originals(cells: Sequence[Cell]) -> Iterator[str]:
    if not cells:
        return
    yield "**Original images**: what is left without a codec and a link, mean translation-direction error in"
    yield "degrees. Nothing behind a link can be expected to be better.\n"
    rows = []
    for title, group in _groups(cells):
        if ";" in title:
            figures = [number(finite_mean(c.mean(m) for c in group), 1) for m in _METHODS]
            rows.append([title, str(len(group)), *figures])
    yield from table(["cells of", "number", *_METHODS], rows)


def _what_confidence_gives(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**What confidence gives**: ratio of mean translation-direction errors, geometric mean over cells."
    yield "`robust` searches once more than `off` at each threshold, in the order of confidence, and fits"
    yield "weights to it. `shuffled` does the same with the confidence of other points, which says nothing:"
    yield "`shuffled / off` is what the additional search gives, `robust / shuffled` what confidence gives."
    yield "In brackets the 95 % interval over cells drawn anew; cells of a recording share its images, so it"
    yield "is rather too narrow.\n"
    held_out = [c for c in cells if c.recording in HELD_OUT]
    groups = {
        "all": cells,
        "tracks (klt)": _of_features(cells, "klt"),
        "descriptor matches (sift)": _of_features(cells, "sift"),
        f"{BAD_LINK_DB:g} dB and below": [c for c in cells if _is_bad_link(c)],
        "recordings tuned on": [c for c in cells if c.recording not in HELD_OUT],
        "recordings by which no constant was chosen": held_out,
        "of these tracks": _of_features(held_out, "klt"),
        "of these descriptor matches": _of_features(held_out, "sift"),
    }
    rows = [
        [title, str(len(group)), *(ratio_text(group, *pair) for pair in _RATIOS)]
        for title, group in groups.items()
        if group
    ]
    yield from table(["cells of", "number", *(f"{ours} / {theirs}" for ours, theirs in _RATIOS)], rows)


def _is_bad_link(cell: Cell) -> bool:
    return float(cell.values["snr_db"]) <= BAD_LINK_DB


def _with_and_without(cells: Sequence[Cell]) -> Iterator[str]:
    """Hold the paper's claim against the comparison that it is about."""
    bad = [c for c in cells if _is_bad_link(c)]
    if not bad:
        return
    yield "**What the paper claims** (Fig. 9 and 10): the same estimator errs by 1-2 degrees of rotation less"
    yield "with confidence than without, and at 2-6 dB by 8-10 degrees of translation direction. The same"
    yield f"comparison here, at {BAD_LINK_DB:g} dB and below: error without, and gain with confidence.\n"
    rows = []
    for title, group in _groups(bad):
        row = [title, str(len(group))]
        for figure in _CLAIMED_DEG:
            for ours, theirs in _ALIKE:
                row += _error_and_gains(group, theirs, (ours,), figure)
        rows.append(row)
    names = [
        name
        for figure in ("rotation", "direction")
        for ours, theirs in _ALIKE
        for name in (f"{figure}, {theirs}", f"gain, {ours}")
    ]
    yield from table(["cells of", "number", *names], rows)
    yield ""
    gains = {pair: [_median_gain(bad, *pair, figure) for figure in _CLAIMED_DEG] for pair in _ALIKE}
    if not any(
        g >= least for gain in gains.values() for g, least in zip(gain, _CLAIMED_DEG.values(), strict=True)
    ):
        yield "Not reproduced."
    for (ours, theirs), (rot, tdir) in gains.items():
        yield f"`{ours}` gains {rot:+.1f} of rotation and {tdir:+.1f} of direction over `{theirs}` in the"
        yield "median of the cells."


def _error_and_gains(cells: Sequence[Cell], rival: str, methods: Sequence[str], figure: str) -> list[str]:
    """Return a rival's mean error and by how much those of others are less, as text."""
    plain = finite_mean(c.mean(rival, figure) for c in cells)
    texts = [number(plain, 1)]
    for method in methods:
        ours = finite_mean(c.mean(method, figure) for c in cells)
        texts.append("-" if plain is None or ours is None else f"{plain - ours:+.1f}")
    return texts


def _against_plain(cells: Sequence[Cell]) -> Iterator[str]:
    bad = [c for c in cells if _is_bad_link(c)]
    if not bad:
        return
    yield f"**Gain over plain RANSAC (OpenCV's) at {BAD_LINK_DB:g} dB and below**, in degrees of the mean"
    yield "error. Local optimisation, a truncated score and a refinement give it, which `off` has too.\n"
    rows = []
    for title, group in _groups(bad):
        row = [title, str(len(group))]
        for figure in _CLAIMED_DEG:
            row += _error_and_gains(group, PLAIN, _AGAINST_PLAIN, figure)
        rows.append(row)
    names = ("plain", *_AGAINST_PLAIN)
    figures = (f"{figure}, {name}" for figure in ("rotation", "direction") for name in names)
    head = ["cells of", "number", *figures]
    yield from table(head, rows)
    yield "\nIn the median of the cells:\n"
    for method in _AGAINST_PLAIN:
        rot, tdir = (_median_gain(bad, method, PLAIN, figure) for figure in _CLAIMED_DEG)
        yield f"- `{method}`: {rot:+.1f} of rotation and {tdir:+.1f} of direction."
    yield f"\n`{UNWEIGHTED_PAPER}` and `paper` measure matches by the algebraic residual of the paper's"
    yield "Eq. 18. It is smaller the nearer a match is to an epipole: a motion along the optical axis, which"
    yield "puts the epipole among the matches, gets the most inliers, whatever the camera did. Where it moved"
    yield "sideways that costs both far more than confidence changes."


def _median_gain(cells: Sequence[Cell], ours: str, theirs: str, figure: str) -> float:
    gains = [
        b - a
        for c in cells
        if (b := c.mean(theirs, figure)) is not None and (a := c.mean(ours, figure)) is not None
    ]
    return float(np.median(gains)) if gains else float("nan")


def _misleading(cells: Sequence[Cell]) -> Iterator[str]:
    yield "**What a misleading confidence costs**: AUC@10 in points minus that of `off`, mean and worst."
    yield "`off` and `constant` have a search less than the others.\n"
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
        [cue, *(number(finite_mean(found.get((*kind, cue), ()))) for kind in kinds)]
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


def _log_ratios(cells: Iterable[Cell], ours: str, theirs: str) -> Array:
    pairs = [(c.mean(ours), c.mean(theirs)) for c in cells]
    return np.array([np.log(a / b) for a, b in pairs if a and b], dtype=np.float64)


def _ratio(cells: Iterable[Cell], ours: str, theirs: str) -> float:
    """Geometric mean of the ratios of mean translation-direction errors; NaN without any."""
    logs = _log_ratios(cells, ours, theirs)
    return float(np.exp(logs.mean())) if len(logs) else float("nan")


def ratio_text(cells: Iterable[Cell], ours: str, theirs: str) -> str:
    """Return the geometric mean of the ratios of errors with its 95 % bootstrap interval over cells.

    Without an interval where there are too few cells for one, a dash without any.
    """
    logs = _log_ratios(cells, ours, theirs)
    if not len(logs):
        return "-"
    if len(logs) < MIN_SAMPLES:
        return f"{np.exp(logs.mean()):.2f}"
    return with_interval(*mean_ratio([logs]))
