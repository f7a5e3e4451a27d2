"""``semcast eval trajectory``: reconstruct a recording over a link, compare the path with the truth."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from semcast.common.codec import Codec
from semcast.common.errors import SemcastError
from semcast.common.trajectory import Trajectory, write_tum
from semcast.common.trajectory_error import MIN_MATCHES, ate
from semcast.evaluation.gap import Gap, gap_in, outside, recovery_s
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.pipeline import (
    CLEAN,
    ORIGINALS_BYTES,
    UNUSED_LINK_FIELDS,
    FrameRun,
    StreamSettings,
    open_stream,
    select_frames,
)
from semcast.evaluation.plots import plot_path
from semcast.evaluation.reconstruct import ReconstructedRun, reconstruct
from semcast.evaluation.report import naming, provenance, write_result
from semcast.evaluation.statistics import paired_bootstrap
from semcast.evaluation.trace_snr import snr_file_label, stated_snr_db
from semcast.server.geometry.weighting import ConfidenceMode
from semcast.server.mapping.settings import ReconstructionSettings

logger = logging.getLogger(__name__)

VERB = "eval trajectory"
#: Flags that this verb sets itself: the mode is a list here, the seed is that of the run.
UNUSED_FIELDS = UNUSED_LINK_FIELDS | {"reconstruction.confidence", "reconstruction.seed"}
#: Longest gap: far beyond what any motion can bridge.
MAX_GAP_S = 60.0
#: Figures of a run that are summarised over seeds.
FIGURES = (
    "ate_rmse_m",
    "ate_percent",
    "ate_at_once_percent",
    "completeness",
    "completeness_at_once",
    "stated_ratio_trans",
    "stated_ratio_rot",
    "rpe_trans_percent",
    "rpe_rot_deg",
    "psnr_db",
)
#: Those of which the largest is the best.
_LARGEST_IS_BEST = frozenset({"completeness", "completeness_at_once", "psnr_db"})


@dataclass(frozen=True, kw_only=True)
class TrajectorySettings(StreamSettings):
    """Settings of ``evaluate_trajectory``.

    Raises:
        ValueError: A value is out of range.
    """

    confidence: tuple[ConfidenceMode, ...] = field(
        default=("robust",), metadata={"help": "ways to use confidence, all on the same decoded images"}
    )
    reconstruction: ReconstructionSettings = field(
        default=ReconstructionSettings(), metadata={"help": "the server's estimation"}
    )
    gap_s: float = field(
        default=0.0,
        metadata={
            "help": "seconds of every run in which nothing arrives, at another place for each seed; frames "
            "of that time count neither as lost nor for completeness"
        },
    )
    rows: bool = field(default=True, metadata={"help": "keep one row per frame in the result"})
    out: Path | None = field(
        default=None,
        metadata={
            "help": "folder for trajectories (TUM) and drawn paths of the first seed and, without --json, "
            "result.json"
        },
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if not self.confidence or len(set(self.confidence)) != len(self.confidence):
            raise ValueError(f"confidence must be one or more different modes, got {self.confidence}")
        if not 0.0 <= self.gap_s <= MAX_GAP_S:
            raise ValueError(f"gap_s must be in [0, {MAX_GAP_S:g}], got {self.gap_s:g}")


def evaluate_trajectory(settings: TrajectorySettings, codec: Codec | None = None) -> dict[str, Any]:
    """Reconstruct the recording for every SNR, seed and confidence mode.

    Args:
        settings: What to run.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        Provenance and ``cells``: one entry per SNR (``snr_db``, of a trace its start, None for that of a
        file and without a link) and mode with the median over seeds of each figure in ``FIGURES``,
        ``num_failed`` (runs without a path), and ``runs``, the full summary of each seed. Errors are of the
        path after all corrections, but for ``ate_at_once_percent``; ``completeness`` counts frames that got
        their pose later as well, ``completeness_at_once`` does not. ``stated_ratio_trans`` and
        ``stated_ratio_rot`` are those of ``live_poses.stated_ratios``.
        ``comparisons`` holds, per SNR, the paired difference in ATE of each mode to the mode ``off`` where
        that was run. ``frames_left_out`` are those that can't be read. With one cell its figures and
        ``stage_ms`` also stand at the top level. With a gap, runs have ``gap``, its first and last frame and
        ``recovery_s``, see ``recovery_s``, and cells the median of that.

    Raises:
        SourceError: The recording can't be read.
        ConfigError: The codec is unknown.
        SemcastError: A result file can't be written.
    """
    settings = naming(settings, codec)
    sequence, codec = open_stream(settings, codec)
    truth = sequence.groundtruth()
    if doubt := sequence.doubt:
        logger.warning("%s is %s", sequence.name, doubt)
    has_truth = _is_usable(truth, sequence.name, len(sequence))
    chosen = select_frames(sequence, settings, keep_bytes=ORIGINALS_BYTES)
    # Without a link neither SNR nor channel seed changes an image: one SNR stands for all.
    snrs_db = settings.snr_db if codec is not None else settings.snr_db[:1]
    runs: dict[tuple[float, str], list[dict[str, Any]]] = {}
    to_draw: dict[str, ReconstructedRun] = {}
    with until_interrupted(runs) as part:
        for snr_db, seed in product(snrs_db, settings.all_seeds):
            gap = gap_in(chosen.ids, sequence.times_ns, settings.gap_s, seed) if settings.gap_s else None
            ids = chosen.ids if gap is None else outside(chosen.ids, gap)
            frames = FrameRun(sequence, ids, codec, settings.link_at(snr_db), seed, images=chosen.images)
            for mode in settings.confidence:
                how = replace(settings.reconstruction, confidence=mode, seed=seed)
                run = reconstruct(frames, sequence.intrinsics, how, truth)
                entry = _run_entry(run, seed, gap, with_rows=settings.rows)
                runs.setdefault((snr_db, mode), []).append(entry)
                if seed == settings.seed:
                    label = CLEAN if codec is None else snr_file_label(snr_db, settings.link)
                    to_draw[f"{label}_{mode}"] = run
    cells = [
        _cell(
            None if codec is None else stated_snr_db(snr_db, settings.link),
            mode,
            of_cell,
            has_truth=has_truth,
        )
        for (snr_db, mode), of_cell in runs.items()
    ]
    report = {
        **provenance(VERB, settings),
        "sequence": sequence.name,
        "num_frames": len(chosen.ids),
        "frames_left_out": chosen.left_out,
        "cells": cells,
        "comparisons": _comparisons(cells, settings.seed),
    }
    if len(cells) == 1:
        report |= {key: value for key, value in cells[0].items() if key != "runs"}
        report["stage_ms"] = cells[0]["runs"][0]["stage_ms"]
    written = write_result(settings.json, report, part)
    if settings.out is not None:  # last: a disk that is full costs the pictures, not the figures
        for label, run in to_draw.items():
            _write_files(settings.out, label, run)
    return written


def _run_entry(run: ReconstructedRun, seed: int, gap: Gap | None, *, with_rows: bool) -> dict[str, Any]:
    entry = {"seed": seed, **run.summary, "num_landmarks": run.num_landmarks}
    if gap is not None:
        entry["gap"] = {**vars(gap), "recovery_s": recovery_s(run.rows, gap)}
    return {**entry, "rows": run.rows} if with_rows else entry


def median_or_none(values: Sequence[float | None], *, largest_is_best: bool = False) -> float | None:
    """Return the median with None counted as worse than any number; None when that is the median."""
    worst = -np.inf if largest_is_best else np.inf
    median = float(np.median([worst if v is None else v for v in values])) if len(values) else worst
    return median if np.isfinite(median) else None


def _is_usable(truth: Trajectory | None, name: str, num_images: int) -> bool:
    """Whether errors against this true path mean something; if not, that is told as a warning.

    Then no run is to blame for having no error. A truth of less than half of the images is told as well.
    """
    if truth is None:
        logger.warning("%s has no true path: how far its poses are off is unknown", name)
        return False
    if len(truth) < MIN_MATCHES or truth.path_length <= 0.0:
        logger.warning(
            "%s has a true path of %d poses and length %.3g: too short to say how far its poses are off",
            *(name, len(truth), truth.path_length),
        )
        return False
    if 2 * len(truth) < num_images:
        logger.warning(
            "%s has true poses of %d of its %d images: errors are those of these alone",
            *(name, len(truth), num_images),
        )
    return True


def _has_failed(run: Mapping[str, Any], *, has_truth: bool) -> bool:
    """Whether a run has no path to speak of; without a truth all that is known is how many poses it has."""
    return run["ate_percent"] is None if has_truth else run["num_posed"] < MIN_MATCHES


def _cell(snr_db: float | None, mode: str, runs: list[dict[str, Any]], *, has_truth: bool) -> dict[str, Any]:
    return {
        "snr_db": snr_db,
        "confidence": mode,
        "seeds": [run["seed"] for run in runs],
        **{
            name: median_or_none([run[name] for run in runs], largest_is_best=name in _LARGEST_IS_BEST)
            for name in FIGURES
        },
        **(
            {"recovery_s": median_or_none([run["gap"]["recovery_s"] for run in runs])}
            if "gap" in runs[0]
            else {}
        ),
        "num_failed": sum(_has_failed(run, has_truth=has_truth) for run in runs),
        "runs": runs,
    }


def _comparisons(cells: list[dict[str, Any]], seed: int) -> list[dict[str, Any]]:
    """Pair each mode with ``off`` over the seeds in which both have an error; say how many have not."""
    found = []
    for cell in cells:
        rival = next((c for c in cells if c["snr_db"] == cell["snr_db"] and c["confidence"] == "off"), None)
        if rival is None or cell is rival:
            continue
        pairs = [
            (a["ate_percent"], b["ate_percent"])
            for a, b in zip(cell["runs"], rival["runs"], strict=False)  # a part may lack the last seed
            if a["ate_percent"] is not None and b["ate_percent"] is not None
        ]
        ours, theirs = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        found.append(
            {
                "snr_db": cell["snr_db"],
                "confidence": cell["confidence"],
                "against": "off",
                "figure": "ate_percent",
                "paired": paired_bootstrap(ours, theirs, np.random.default_rng(seed)),
                "num_left_out": max(len(cell["runs"]), len(rival["runs"])) - len(pairs),
            }
        )
    return found


def _write_files(folder: Path, label: str, run: ReconstructedRun) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_tum(folder / f"trajectory_{label}.tum", run.trajectory)
    except OSError as err:
        raise SemcastError(f"{folder} can't be written: {err}") from err
    truth = run.truth
    absolute = ate(run.trajectory, truth) if truth is not None else None
    if absolute is None or truth is None:
        return
    aligned = absolute.scale * run.trajectory.positions @ absolute.R_truth_map.T + absolute.t_truth_map
    widest = np.sort(np.argsort(np.ptp(truth.positions, axis=0))[1:])
    plot_path(
        folder / f"path_{label}.png",
        {"ground truth": truth.positions, "semcast": aligned},
        axes_names=("xyz"[widest[0]], "xyz"[widest[1]]),
        title=f"ATE {absolute.percent:.2g} % of {absolute.path_length:.3g} {absolute.unit}",
        unit=absolute.unit,
    )
