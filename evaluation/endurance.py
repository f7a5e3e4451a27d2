"""``semcast eval endurance``: does cost per frame or memory grow when the server runs for long?

A recording is passed back and forth, so that a short one gives as many frames as wanted and old places keep
coming back. Frames are sent and decoded once; only estimation is measured, as in the live server: bundle
adjustment in its own process.
"""

import logging
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from semcast.common.codec import Codec
from semcast.common.errors import ConfigError
from semcast.common.playback import usual_period_ns
from semcast.common.sequence import Sequence
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import trajectory_summary
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.pipeline import (
    UNUSED_IN_ONE_RUN,
    FrameRun,
    OneRunSettings,
    open_stream,
    select_frames,
)
from semcast.evaluation.reconstruct import as_received, cut_to_frames
from semcast.evaluation.report import naming, provenance, write_result
from semcast.evaluation.trace_snr import snr_label
from semcast.server.export.outputs import trajectory_of
from semcast.server.mapping.bundle_process import ProcessBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.state import DecodedFrame

logger = logging.getLogger(__name__)

VERB = "eval endurance"
UNUSED_FIELDS = UNUSED_IN_ONE_RUN


@dataclass(frozen=True, kw_only=True)
class EnduranceSettings(OneRunSettings):
    """Settings of ``evaluate_endurance``.

    Raises:
        ValueError: A value is out of range.
    """

    frames: int = field(default=20_000, metadata={"help": "frames in all, back and forth"})
    every: int = field(default=1000, metadata={"help": "frames a row of the result is about"})

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if self.frames < 1:
            raise ValueError(f"frames must be at least 1, got {self.frames}")
        if not 1 <= self.every <= self.frames:
            raise ValueError(f"every must be in [1, {self.frames}], got {self.every}")


def back_and_forth(num_frames: int, total: int) -> Iterator[int]:
    """Yield ``total`` indices that run from 0 to the last frame and back, again and again."""
    lap = [*range(num_frames), *range(num_frames - 2, 0, -1)]
    for k in range(total):
        yield lap[k % len(lap)]


def resident_mb(pid: int | None = None) -> float:
    """Memory of a process in MB, by default this one; 0 where the operating system does not say."""
    try:
        statm = Path(f"/proc/{'self' if pid is None else pid}/statm").read_text(encoding="ascii")
        pages = int(statm.split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def evaluate_endurance(settings: EnduranceSettings, codec: Codec | None = None) -> dict[str, Any]:
    """Run the estimation over many frames and watch its cost.

    Args:
        settings: What to run.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        Provenance; ``results``, a row for every ``settings.every`` frames: ``frames`` so far,
        ``posed_share``, ``frame_ms_p50`` and ``frame_ms_p95`` (decoded frame to pose), ``landmarks``,
        ``keyframes`` with observations, ``memory_mb`` and
        ``bundle_memory_mb`` of the adjustments' process, and ``ate_rmse_m`` of the row's frames and that in
        percent of one pass, ``ate_percent``, where the recording has a truth; ``growth``: last row over the
        first of the second half.

    Raises:
        SourceError: The recording can't be read.
        ConfigError: The codec is unknown, or too few frames arrive.
    """
    settings = naming(settings, codec)
    sequence, codec = open_stream(settings, codec)
    chosen = select_frames(sequence, settings)
    frames = _received(sequence, chosen.ids, codec, settings)
    rows: list[dict[str, Any]] = []
    with until_interrupted(rows) as part:
        _measure(frames, sequence, settings, rows)
    middle, last = rows[len(rows) // 2], rows[-1]
    keys = ("frame_ms_p50", "frame_ms_p95", "landmarks", "keyframes", "memory_mb", "bundle_memory_mb")
    report = {
        **provenance(VERB, settings),
        "sequence": sequence.name,
        "image_wh": [sequence.intrinsics.width, sequence.intrinsics.height],
        "frames_left_out": chosen.left_out,
        "growth": {key: last[key] / middle[key] if middle[key] else None for key in keys},
        "results": rows,
    }
    return write_result(settings.json, report, part)


def _received(
    sequence: Sequence, frame_ids: list[int], codec: Codec | None, settings: EnduranceSettings
) -> list[DecodedFrame]:
    """Frames that arrive, decoded."""
    run = FrameRun(sequence, frame_ids, codec, settings.the_link, settings.seed, cache_bytes=0)
    frames = [as_received(frame) for frame in run if frame.decoded is not None]
    if not frames:
        level = snr_label(settings.snr_db[0], settings.link)
        raise ConfigError(f"no frame was received at {level}: there is nothing to run")
    if len(frames) < 3:
        raise ConfigError(f"max_frames must leave at least 3 frames that arrive, got {len(frames)}")
    return frames


def _measure(
    frames: list[DecodedFrame], sequence: Sequence, settings: EnduranceSettings, rows: list[dict[str, Any]]
) -> None:
    """Pass the frames back and forth and add to ``rows``, one for every ``settings.every``."""
    interval_ns = int(usual_period_ns(np.array([f.t_source_ns for f in frames])))
    truth = sequence.groundtruth()
    times_ms: list[float] = []
    seen: list[tuple[int, int]] = []
    bundle = ProcessBundle(lossless=False)
    reconstruction = Reconstruction(sequence.intrinsics, settings.estimation, bundle)
    try:
        for k, index in enumerate(back_and_forth(len(frames), settings.frames)):
            since = time.perf_counter_ns()
            reconstruction.process(replace(frames[index], frame_id=k, t_source_ns=k * interval_ns))
            times_ms.append((time.perf_counter_ns() - since) * 1e-6)
            seen.append((k, index))
            if (k + 1) % settings.every == 0:
                row = _row(reconstruction, times_ms, seen, frames, truth, interval_ns)
                row["bundle_memory_mb"] = resident_mb(bundle.pid) if bundle.pid is not None else 0.0
                rows.append(row)
                told = (k + 1, settings.frames, row["frame_ms_p50"], row["memory_mb"])
                logger.info("%d of %d frames: p50 %.1f ms a frame, %.0f MB", *told)
                times_ms, seen = [], []
    finally:
        reconstruction.close()


def _row(
    reconstruction: Reconstruction,
    times_ms: list[float],
    seen: list[tuple[int, int]],
    frames: list[DecodedFrame],
    truth: Trajectory | None,
    interval_ns: int,
) -> dict[str, Any]:
    poses = reconstruction.final_trajectory()
    posed = {k: poses[k] for k, _ in seen if k in poses}
    row: dict[str, Any] = {
        "frames": seen[-1][0] + 1,
        "posed_share": len(posed) / len(seen),
        "frame_ms_p50": float(np.percentile(times_ms, 50)),
        "frame_ms_p95": float(np.percentile(times_ms, 95)),
        "landmarks": len(reconstruction.landmarks()[0]),
        "keyframes": len(np.unique(reconstruction.world.observations()[1])),
        "memory_mb": resident_mb(),
    }
    if truth is not None and len(posed) >= 3:
        # The same places at the times of this pass.
        at_ns = {k: k * interval_ns for k, _ in seen}
        true_poses = dict(zip(truth.t_s.tolist(), truth.T_world_cam, strict=True))
        own_s = {k: frames[index].t_source_ns * 1e-9 for k, index in seen}
        places = {k: true_poses[t_s] for k, t_s in own_s.items() if t_s in true_poses}
        ridden = replace(trajectory_of(places, at_ns), in_metres=truth.in_metres)
        summary = trajectory_summary(trajectory_of(posed, at_ns), ridden, len(seen))
        row["ate_rmse_m"] = summary["ate_rmse_m"]
        # Of one pass, as for a run that ends there: ridden back and forth, the path grows and errors do not.
        one_pass = cut_to_frames(truth, {f.frame_id: f.t_source_ns for f in frames}).path_length
        if summary["ate_percent"] is not None and one_pass > 0:
            row["ate_percent"] = summary["ate_percent"] * ridden.path_length / one_pass
    return row
