"""``semcast eval pairs``: relative pose of frame pairs (k, k + gap), for every way to use confidence."""

import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from itertools import product
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
from semcast.common.times import ns_to_seconds
from semcast.evaluation.competitors import COMPETITORS
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.match_truth import epipolar_distance_px, track_error_px
from semcast.evaluation.pair_cell import PairCell, PairOutcome, merge_cells
from semcast.evaluation.pair_matches import Features, PairMatches, match_pair
from semcast.evaluation.pair_methods import (
    Estimator,
    competitor_estimator,
    confidence_estimator,
    match_confidence,
)
from semcast.evaluation.pipeline import (
    ORIGINALS_BYTES,
    UNUSED_LINK_FIELDS,
    FrameRun,
    LinkedFrame,
    StreamSettings,
    open_stream,
    select_frames,
)
from semcast.evaluation.plots import plot_pair_errors
from semcast.evaluation.pose_error import relative_pose_error
from semcast.evaluation.report import naming, provenance, short_names, write_result
from semcast.evaluation.statistics import finite_mean, percentiles
from semcast.evaluation.trace_snr import stated_snr_db
from semcast.server.geometry.agreement import neighbour_agreement
from semcast.server.geometry.weighting import ConfidenceMode

Array = NDArray[np.float64]

VERB = "eval pairs"
#: Flags that have no meaning here.
UNUSED_FIELDS = UNUSED_LINK_FIELDS
_THINNING_STREAM = 0x7417
#: PoseLib on the matches near their true epipolar lines alone: about what a perfect choice among them gives.
ORACLE = "oracle"


@dataclass(frozen=True, kw_only=True)
class PairSettings(StreamSettings):
    """Settings of ``evaluate_pairs``.

    Raises:
        ValueError: A value is out of range.
    """

    gap: tuple[int, ...] = field(
        default=(1,),
        metadata={"help": "frames from the first to the second image, after --stride; one or more"},
    )
    features: tuple[Features, ...] = field(
        default=("klt",), metadata={"help": "how points are matched: klt, orb or sift; one or more"}
    )
    confidence: tuple[ConfidenceMode, ...] = field(
        default=("robust", "paper", "off"),
        metadata={"help": "ways to use confidence, all on the same matches of the same decoded images"},
    )
    competitors: bool = field(
        default=True, metadata={"help": "also run OpenCV RANSAC, MAGSAC++ and PoseLib on the same matches"}
    )
    max_features: int = field(default=800, metadata={"help": "keypoints per image at most"})
    max_matches: tuple[int, ...] = field(
        default=(0,),
        metadata={"help": "thin the matches of each pair to so many, at random; 0 keeps all; one or more"},
    )
    threshold_px: float = field(default=1.0, metadata={"help": "inlier threshold of all methods but paper"})
    inlier_px: float = field(
        default=2.0, metadata={"help": "a match is truly right within so many pixels, for the AUROC"}
    )
    min_baseline_m: float = field(default=0.03, metadata={"help": "skip pairs with a smaller true baseline"})
    min_baseline_share: float = field(
        default=0.0, metadata={"help": "skip pairs with a baseline below this share of the path's extent"}
    )
    out: Path | None = field(
        default=None,
        metadata={"help": "folder for plots of error against SNR and, without --json, result.json"},
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if not self.confidence or len(set(self.confidence)) != len(self.confidence):
            raise ValueError(f"confidence must be one or more different modes, got {self.confidence}")
        if self.max_features < 8:
            raise ValueError(f"max_features must be at least 8, got {self.max_features}")
        for name in ("gap", "features", "max_matches"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ValueError(f"{name} must be one or more different values, got {values}")
        if min(self.gap) < 1:
            raise ValueError(f"gap must be at least 1, got {min(self.gap)}")
        if any(count != 0 and count < 5 for count in self.max_matches):
            raise ValueError(f"max_matches must be 0 or at least 5, got {self.max_matches}")
        for name in ("threshold_px", "inlier_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name):g}")
        if not self.min_baseline_m >= 0 or not 0 <= self.min_baseline_share < 1:
            raise ValueError(
                "min_baseline_m must be at least 0 and min_baseline_share in [0, 1), "
                f"got {self.min_baseline_m:g} and {self.min_baseline_share:g}"
            )


@dataclass(frozen=True)
class _Variant:
    """What is matched: frames so far apart, by these features, thinned to so many (0: all)."""

    gap: int
    features: Features
    max_matches: int


def evaluate_pairs(settings: PairSettings, codec: Codec | None = None) -> dict[str, Any]:
    """Estimate the relative pose of every pair, by every method, on the same matches of the same images.

    Every frame is sent and decoded once per SNR and seed, whatever is made of it.

    Args:
        settings: What to run.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        Provenance and ``cells``, one per SNR (of a trace its start, None for that of a file), ``gap``,
        ``features`` and ``max_matches``: ``results`` (method -> ``rot_deg_mean``,
        ``rot_deg_median``, ``tdir_deg_mean``, ``tdir_deg_median``, ``auc5``, ``auc10``,
        ``auc20``, ``num_failed`` and ``cpu_ms``, the processor time of the estimation; ``oracle`` is PoseLib
        on the true inliers alone), ``auroc`` (kind of truth -> cue -> AUROC) with ``auroc_confidence`` for
        the codec's own confidence and epipolar truth, and ``comparisons``: paired differences to ``off`` and
        the competitors with 95 % intervals.
        ``results``, ``auroc`` and ``auroc_confidence`` at the top level are over all cells together.
        A pair with a lost frame counts as failed under every method.

    Raises:
        SourceError: The recording can't be read.
        ConfigError: The codec is unknown, there is no ground truth, or no pair has the baseline asked for.
    """
    settings = naming(settings, codec)
    sequence, codec = open_stream(settings, codec)
    chosen = select_frames(sequence, settings, keep_bytes=ORIGINALS_BYTES)
    motions = {gap: true_motions(sequence, chosen.ids, settings, gap) for gap in settings.gap}
    methods = [*settings.confidence, *((*COMPETITORS, ORACLE) if settings.competitors else ())]
    # Without a link the SNR changes nothing: one cell stands for all.
    snrs_db: tuple[float | None, ...] = settings.snr_db if codec is not None else (None,)
    variants = [
        _Variant(*choice) for choice in product(settings.gap, settings.features, settings.max_matches)
    ]
    quality_db: dict[float | None, list[float]] = {snr_db: [] for snr_db in snrs_db}
    cells: dict[tuple[float | None, _Variant], PairCell] = {}
    with until_interrupted(cells) as part:
        for snr_db, seed in product(snrs_db, settings.all_seeds):
            link = settings.link_at(snr_db) if snr_db is not None else settings.link
            run = FrameRun(sequence, chosen.ids, codec, link, seed, images=chosen.images, cache_bytes=0)
            of_run = _pairs(run, settings.gap, motions, sequence.intrinsics, quality_db[snr_db])
            for gap, pair_idx, pair in of_run:
                for variant, outcome in _measure(pair, gap, settings, seed):
                    cells.setdefault((snr_db, variant), PairCell(methods)).add(pair_idx, seed, outcome)
    entries = [
        {
            "snr_db": None if snr_db is None else stated_snr_db(snr_db, settings.link),
            "psnr_db": finite_mean(quality_db[snr_db]),
            **asdict(variant),
            **_entry(cells[snr_db, variant], variant, settings),
        }
        for snr_db, variant in product(snrs_db, variants)
        if (snr_db, variant) in cells
    ]
    merged = merge_cells(methods, [cells[key] for key in product(snrs_db, variants) if key in cells])
    report = write_result(
        settings.json,
        {
            **provenance(VERB, settings),
            "sequence": sequence.name,
            "title": f"{sequence.name}, {short_names([settings.codec])[0]}, {settings.link.channel}",
            "frames_left_out": chosen.left_out,
            "num_pairs": sum(len(of_gap) for of_gap in motions.values()),
            "results": merged.results(),
            "auroc": merged.auroc_of_cues(),
            "auroc_confidence": _auroc_confidence(merged),
            "cells": entries,
        },
        part,
    )
    if settings.out is not None and codec is not None and settings.link.channel != "trace":
        plot_pair_errors(settings.out, report)
    return report


def true_motions(
    sequence: RecordedSequence, frame_ids: list[int], settings: PairSettings, gap: int
) -> dict[tuple[int, int], Array]:
    """Return ``(first frame, second frame) -> T_cam1_cam0`` of the pairs with the baseline asked for.

    Raises:
        ConfigError: There is no ground truth, or no such pair.
    """
    truth = sequence.groundtruth()
    if truth is None:
        raise ConfigError(f"sequence {sequence.name} must have ground truth to compare pairs with")
    frame_of_time = {t_s: k for k, t_s in enumerate(ns_to_seconds(sequence.times_ns).tolist())}
    T_world_cam = {frame_of_time[t]: T for t, T in zip(truth.t_s.tolist(), truth.T_world_cam, strict=True)}
    extent_m = float(np.linalg.norm(np.ptp(truth.positions, axis=0)))
    least_m = max(settings.min_baseline_m, settings.min_baseline_share * extent_m)
    if len(frame_ids) <= gap:
        raise ConfigError(f"pairs at gap {gap} need at least {gap + 1} frames, got {len(frame_ids)}")
    motions = {}
    for id0, id1 in zip(frame_ids, frame_ids[gap:], strict=False):
        if id0 not in T_world_cam or id1 not in T_world_cam:
            continue
        T_cam1_cam0 = invert_transform(T_world_cam[id1]) @ T_world_cam[id0]
        if np.linalg.norm(T_cam1_cam0[:3, 3]) >= least_m:
            motions[id0, id1] = T_cam1_cam0
    if not motions:
        raise ConfigError(
            f"no pair of {sequence.name} has ground truth and a baseline of {least_m:.3g} m at gap "
            f"{gap}: try a larger --gap"
        )
    return motions


def _neighbours(
    run: FrameRun, gaps: tuple[int, ...], quality_db: list[float]
) -> Iterator[tuple[int, int, LinkedFrame, LinkedFrame]]:
    """Yield gap, index of the first frame, and two frames that far apart, holding only those in between.

    The PSNR is collected on the way.
    """
    recent: deque[LinkedFrame] = deque(maxlen=max(gaps) + 1)
    for idx, frame in enumerate(run):
        if frame.decoded is not None and frame.row_snr_db is not None:
            quality_db.append(psnr_db(frame.original, frame.decoded.image))
        recent.append(frame)
        for gap in gaps:
            if len(recent) > gap:
                yield gap, idx - gap, recent[-1 - gap], recent[-1]


@dataclass(frozen=True)
class _Pair:
    frame0: LinkedFrame
    frame1: LinkedFrame
    T_cam1_cam0: Array
    camera: Intrinsics


def _pairs(
    run: FrameRun,
    gaps: tuple[int, ...],
    motions: Mapping[int, Mapping[tuple[int, int], Array]],
    camera: Intrinsics,
    quality_db: list[float],
) -> Iterator[tuple[int, int, _Pair]]:
    """Yield gap, index and pair of those neighbours whose true motion is one to measure by."""
    for gap, idx, frame0, frame1 in _neighbours(run, gaps, quality_db):
        T_cam1_cam0 = motions[gap].get((frame0.frame_id, frame1.frame_id))
        if T_cam1_cam0 is not None:
            yield gap, idx, _Pair(frame0, frame1, T_cam1_cam0, camera)


def _measure(
    pair: _Pair, gap: int, settings: PairSettings, seed: int
) -> Iterator[tuple[_Variant, PairOutcome]]:
    """Match a pair in every way and give the matches to every estimator."""
    estimators: dict[str, Estimator] = {mode: confidence_estimator(mode) for mode in settings.confidence}
    if settings.competitors:
        estimators |= {name: competitor_estimator(name) for name in COMPETITORS}
    decoded0, decoded1 = pair.frame0.decoded, pair.frame1.decoded
    for features in settings.features:
        if decoded0 is None or decoded1 is None:
            failed = relative_pose_error(None, pair.T_cam1_cam0)
            names = [*estimators, *([ORACLE] if settings.competitors else [])]
            lost = PairOutcome(dict.fromkeys(names, failed), {}, 0, {}, {})
            yield from ((_Variant(gap, features, count), lost) for count in settings.max_matches)
            continue
        found = match_pair(decoded0, decoded1, features, settings.max_features)
        for count in settings.max_matches:
            matches = found
            if 0 < count < len(found):
                rng = np.random.default_rng((seed, _THINNING_STREAM, pair.frame0.frame_id))
                matches = found.take(np.sort(rng.choice(len(found), count, replace=False)))
            outcome = _estimate(matches, pair, estimators, settings, seed)
            yield _Variant(gap, features, count), outcome


def _estimate(
    matches: PairMatches, pair: _Pair, estimators: dict[str, Estimator], settings: PairSettings, seed: int
) -> PairOutcome:
    errors, cpu_ms = {}, {}
    for name, estimate in estimators.items():
        since = time.thread_time_ns()
        T_estimated = estimate(matches, pair.camera, settings.threshold_px, seed)
        cpu_ms[name] = (time.thread_time_ns() - since) * 1e-6
        errors[name] = relative_pose_error(T_estimated, pair.T_cam1_cam0)
    xy0, xy1 = matches.keypoints0_xy, matches.keypoints1_xy
    distance_px = epipolar_distance_px(xy0, xy1, pair.T_cam1_cam0, pair.camera)
    true_inlier = {"epipolar": distance_px < settings.inlier_px}
    if settings.competitors:
        right = matches.take(np.flatnonzero(true_inlier["epipolar"]))
        T_oracle = competitor_estimator("poselib")(right, pair.camera, settings.threshold_px, seed)
        errors[ORACLE] = relative_pose_error(T_oracle, pair.T_cam1_cam0)
    if matches.forward_backward_px is not None:
        error_px = track_error_px(xy0, xy1, pair.frame0.original, pair.frame1.original)
        true_inlier["track"] = error_px < settings.inlier_px
    geometric = match_confidence("robust", matches, seed).astype(np.float32)
    agreement = neighbour_agreement(xy0, xy1).astype(np.float32)
    cues = {**matches.cues, "geometric_confidence": geometric, "neighbour_agreement": agreement}
    return PairOutcome(errors, cpu_ms, len(matches), cues, true_inlier)


def _entry(cell: PairCell, variant: _Variant, settings: PairSettings) -> dict[str, Any]:
    outcomes = cell.outcomes
    rivals = [m for m in ("off",) if m in settings.confidence]
    rivals += list(COMPETITORS) if settings.competitors else []
    kinds = ("epipolar", "track") if variant.features == "klt" else ("epipolar",)
    return {
        "num_pairs_lost": sum(not o.cpu_ms for o in outcomes),
        "num_matches": percentiles([o.num_matches for o in outcomes], (5, 50)),
        "true_inlier_share": {kind: cell.inlier_share(kind) for kind in kinds},
        "results": cell.results(),
        "auroc": cell.auroc_of_cues(),
        "auroc_confidence": _auroc_confidence(cell),
        "comparisons": cell.comparisons(
            settings.confidence, rivals, np.random.default_rng(settings.seed), block=variant.gap + 1
        ),
    }


def _auroc_confidence(cell: PairCell) -> float | None:
    return cell.auroc_of_cues().get("epipolar", {}).get("confidence")
