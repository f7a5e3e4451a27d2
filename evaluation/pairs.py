"""``semcast eval pairs``: relative pose of frame pairs (k, k + gap), for every way to use confidence."""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.codec import Codec
from semcast.common.errors import ConfigError
from semcast.common.geometry import invert_transform
from semcast.common.image import psnr_db
from semcast.common.sequence import Sequence as RecordedSequence
from semcast.evaluation.competitors import COMPETITORS
from semcast.evaluation.match_truth import epipolar_distance_px, track_error_px
from semcast.evaluation.pair_cell import PairCell, PairOutcome, merge_cells
from semcast.evaluation.pair_matches import Features, match_pair
from semcast.evaluation.pair_methods import (
    Estimator,
    competitor_estimator,
    confidence_estimator,
    match_confidence,
)
from semcast.evaluation.pipeline import (
    UNUSED_LINK_FIELDS,
    FrameRun,
    LinkedFrame,
    StreamSettings,
    open_stream,
    selected_frame_ids,
)
from semcast.evaluation.plots import plot_pair_errors
from semcast.evaluation.pose_error import relative_pose_error
from semcast.evaluation.report import json_ready, provenance, write_json
from semcast.evaluation.statistics import finite_mean, percentiles
from semcast.server.weighting import ConfidenceMode

Array = NDArray[np.float64]

VERB = "eval pairs"
#: Flags that have no meaning here.
UNUSED_FIELDS = UNUSED_LINK_FIELDS
_THINNING_STREAM = 0x7417


@dataclass(frozen=True, kw_only=True)
class PairSettings(StreamSettings):
    """Settings of ``evaluate_pairs``.

    Raises:
        ValueError: A value is out of range.
    """

    gap: int = field(
        default=1, metadata={"help": "frames from the first to the second image, after --stride"}
    )
    features: Features = field(default="klt", metadata={"help": "how points are matched: klt, orb or sift"})
    confidence: tuple[ConfidenceMode, ...] = field(
        default=("robust", "paper", "off"),
        metadata={"help": "ways to use confidence, all on the same matches of the same decoded images"},
    )
    competitors: bool = field(
        default=True, metadata={"help": "also run OpenCV RANSAC, MAGSAC++ and PoseLib on the same matches"}
    )
    max_features: int = field(default=800, metadata={"help": "keypoints per image at most"})
    max_matches: int | None = field(
        default=None, metadata={"help": "thin the matches of each pair to so many, at random"}
    )
    threshold_px: float = field(default=1.0, metadata={"help": "inlier threshold of all methods but paper"})
    inlier_px: float = field(
        default=2.0, metadata={"help": "a match is truly right within so many pixels, for the AUROC"}
    )
    min_baseline_m: float = field(default=0.03, metadata={"help": "skip pairs with a smaller true baseline"})
    min_baseline_share: float = field(
        default=0.0, metadata={"help": "skip pairs with a baseline below this share of the path's extent"}
    )
    out: Path | None = field(default=None, metadata={"help": "folder for plots of error against SNR"})

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if not self.confidence or len(set(self.confidence)) != len(self.confidence):
            raise ValueError(f"confidence must be one or more different modes, got {self.confidence}")
        for name, least in (("gap", 1), ("max_features", 8)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if self.max_matches is not None and self.max_matches < 5:
            raise ValueError(f"max_matches must be at least 5, got {self.max_matches}")
        for name in ("threshold_px", "inlier_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name):g}")
        if self.min_baseline_m < 0 or not 0 <= self.min_baseline_share < 1:
            raise ValueError(
                "min_baseline_m must be at least 0 and min_baseline_share in [0, 1), "
                f"got {self.min_baseline_m:g} and {self.min_baseline_share:g}"
            )


def evaluate_pairs(settings: PairSettings, codec: Codec | None = None) -> dict[str, Any]:
    """Estimate the relative pose of every pair, by every method, on the same matches of the same images.

    Args:
        settings: What to run.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        Provenance and ``cells``, one per SNR: ``results`` (method -> ``rot_deg_mean``, ``rot_deg_median``,
        ``tdir_deg_mean``, ``tdir_deg_median``, ``auc5``, ``auc10``, ``auc20``, ``num_failed`` and
        ``elapsed_ms``), ``auroc`` (kind of truth -> cue -> AUROC) with ``auroc_confidence`` for the codec's
        own confidence and epipolar truth, and ``comparisons``: paired differences to ``off`` and the
        competitors with 95 % intervals. ``results``, ``auroc`` and ``auroc_confidence`` at the top level are
        over all SNRs together.
        A pair with a lost frame counts as failed under every method.

    Raises:
        SourceError: The recording can't be read.
        ConfigError: The codec is unknown, there is no ground truth, or no pair has the baseline asked for.
    """
    sequence, codec = open_stream(settings, codec)
    frame_ids = selected_frame_ids(sequence, settings)
    motions = true_motions(sequence, frame_ids, settings)
    methods = [*settings.confidence, *(COMPETITORS if settings.competitors else ())]
    # Without a link the SNR changes nothing: one cell stands for all.
    snrs_db: tuple[float | None, ...] = settings.snr_db if codec is not None else (None,)
    cells = [PairCell(methods) for _ in snrs_db]
    entries = []
    for snr_db, cell in zip(snrs_db, cells, strict=True):
        quality_db: list[float] = []
        link = settings.link_at(snr_db) if snr_db is not None else settings.link
        for seed in settings.all_seeds:
            run = FrameRun(sequence, frame_ids, codec, link, seed, cache_bytes=0)
            for pair_idx, (frame0, frame1) in enumerate(_neighbours(run, settings.gap, quality_db)):
                T_cam1_cam0 = motions.get((frame0.frame_id, frame1.frame_id))
                if T_cam1_cam0 is not None:
                    outcome = _measure(frame0, frame1, T_cam1_cam0, sequence.intrinsics, settings, seed)
                    cell.add(pair_idx, seed, outcome)
        entries.append({"snr_db": snr_db, "psnr_db": finite_mean(quality_db), **_entry(cell, settings)})
    merged = merge_cells(methods, cells)
    report = json_ready(
        {
            **provenance(VERB, settings),
            "sequence": sequence.name,
            "title": f"{sequence.name}, {settings.features}, gap {settings.gap}, {settings.codec}",
            "num_pairs": len(motions),
            "results": merged.results(),
            "auroc": merged.auroc_of_cues(),
            "auroc_confidence": _auroc_confidence(merged),
            "cells": entries,
        }
    )
    if settings.json is not None:
        write_json(settings.json, report)
    if settings.out is not None and codec is not None:
        plot_pair_errors(settings.out, report)
    return dict(report)


def true_motions(
    sequence: RecordedSequence, frame_ids: list[int], settings: PairSettings
) -> dict[tuple[int, int], Array]:
    """Return ``(first frame, second frame) -> T_cam1_cam0`` of the pairs with the baseline asked for.

    Raises:
        ConfigError: There is no ground truth, or no such pair.
    """
    truth = sequence.groundtruth()
    if truth is None:
        raise ConfigError(f"sequence {sequence.name} must have ground truth to compare pairs with")
    frame_of_time = {t_s: k for k, t_s in enumerate((sequence.times_ns * 1e-9).tolist())}
    T_world_cam = {frame_of_time[t]: T for t, T in zip(truth.t_s.tolist(), truth.T_world_cam, strict=True)}
    extent_m = float(np.linalg.norm(np.ptp(truth.positions, axis=0)))
    least_m = max(settings.min_baseline_m, settings.min_baseline_share * extent_m)
    motions = {}
    for id0, id1 in zip(frame_ids, frame_ids[settings.gap :], strict=False):
        if id0 not in T_world_cam or id1 not in T_world_cam:
            continue
        T_cam1_cam0 = invert_transform(T_world_cam[id1]) @ T_world_cam[id0]
        if np.linalg.norm(T_cam1_cam0[:3, 3]) >= least_m:
            motions[id0, id1] = T_cam1_cam0
    if not motions:
        raise ConfigError(
            f"no pair of {sequence.name} has ground truth and a baseline of {least_m:.3g} m at gap "
            f"{settings.gap}: try a larger --gap"
        )
    return motions


def _neighbours(
    run: FrameRun, gap: int, quality_db: list[float]
) -> Iterator[tuple[LinkedFrame, LinkedFrame]]:
    """Yield frames ``gap`` places apart, holding only those in between; collect the PSNR on the way."""
    recent: deque[LinkedFrame] = deque(maxlen=gap + 1)
    for frame in run:
        if frame.decoded is not None and frame.effective_snr_db is not None:
            quality_db.append(psnr_db(frame.original, frame.decoded.image))
        recent.append(frame)
        if len(recent) == gap + 1:
            yield recent[0], recent[-1]


def _measure(
    frame0: LinkedFrame,
    frame1: LinkedFrame,
    T_cam1_cam0: Array,
    camera: Intrinsics,
    settings: PairSettings,
    seed: int,
) -> PairOutcome:
    estimators: dict[str, Estimator] = {mode: confidence_estimator(mode) for mode in settings.confidence}
    if settings.competitors:
        estimators |= {name: competitor_estimator(name) for name in COMPETITORS}
    if frame0.decoded is None or frame1.decoded is None:
        failed = relative_pose_error(None, T_cam1_cam0)
        return PairOutcome(dict.fromkeys(estimators, failed), {}, 0, {}, {})
    matches = match_pair(frame0.decoded, frame1.decoded, settings.features, settings.max_features)
    if settings.max_matches is not None and len(matches) > settings.max_matches:
        rng = np.random.default_rng((seed, _THINNING_STREAM, frame0.frame_id))
        matches = matches.take(np.sort(rng.choice(len(matches), settings.max_matches, replace=False)))
    errors, elapsed_ms = {}, {}
    for name, estimate in estimators.items():
        since = time.perf_counter_ns()
        T_estimated = estimate(matches, camera, settings.threshold_px, seed)
        elapsed_ms[name] = (time.perf_counter_ns() - since) * 1e-6
        errors[name] = relative_pose_error(T_estimated, T_cam1_cam0)
    xy0, xy1 = matches.keypoints0_xy, matches.keypoints1_xy
    true_inlier = {
        "epipolar": epipolar_distance_px(xy0, xy1, T_cam1_cam0, camera) < settings.inlier_px,
    }
    if settings.features == "klt":
        true_inlier["track"] = track_error_px(xy0, xy1, frame0.original, frame1.original) < settings.inlier_px
    geometric = match_confidence("robust", matches, seed).astype(np.float32)
    cues = {**matches.cues, "geometric_confidence": geometric}
    return PairOutcome(errors, elapsed_ms, len(matches), cues, true_inlier)


def _entry(cell: PairCell, settings: PairSettings) -> dict[str, Any]:
    outcomes = cell.outcomes
    rivals = [m for m in ("off",) if m in settings.confidence]
    rivals += list(COMPETITORS) if settings.competitors else []
    kinds = ("epipolar", "track") if settings.features == "klt" else ("epipolar",)
    return {
        "num_pairs_lost": sum(not o.elapsed_ms for o in outcomes),
        "num_matches": percentiles([o.num_matches for o in outcomes], (5, 50)),
        "true_inlier_share": {kind: cell.inlier_share(kind) for kind in kinds},
        "results": cell.results(),
        "auroc": cell.auroc_of_cues(),
        "auroc_confidence": _auroc_confidence(cell),
        "comparisons": cell.comparisons(
            settings.confidence, rivals, np.random.default_rng(settings.seed), block=settings.gap
        ),
    }


def _auroc_confidence(cell: PairCell) -> float | None:
    return cell.auroc_of_cues().get("epipolar", {}).get("confidence")
