"""``semcast eval latency``: where the time goes on the way of a frame, stage by stage."""

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.codec import Codec
from semcast.common.errors import ConfigError
from semcast.common.metrics import duration_percentiles
from semcast.common.trajectory import Trajectory
from semcast.evaluation.pipeline import (
    UNUSED_IN_ONE_RUN,
    FrameRun,
    OneRunSettings,
    open_stream,
    select_frames,
)
from semcast.evaluation.reconstruct import reconstruct
from semcast.evaluation.report import naming, provenance, write_result
from semcast.evaluation.trace_snr import snr_label
from semcast.server.frame_rows import FrameRow
from semcast.server.frame_views import frame_view
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate
from semcast.server.view.picture import compress_picture
from semcast.server.view.scene import Cursor, Scene
from semcast.server.view.settings import ViewSettings

VERB = "eval latency"
UNUSED_FIELDS = UNUSED_IN_ONE_RUN


@dataclass(frozen=True, kw_only=True)
class LatencySettings(OneRunSettings):
    """Settings of ``evaluate_latency``.

    Raises:
        ValueError: A value is out of range.
    """

    warmup: int = field(default=5, metadata={"help": "first frames left out of the figures"})

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if self.warmup < 0:
            raise ValueError(f"warmup must be at least 0, got {self.warmup}")


class ViewStage:
    """What the viewer costs per frame: scene, image compression and writing a recording.

    The live system does this on a thread of its own; here it runs in line, so that it can be timed.

    Args:
        file: Recording to write.
        camera: Camera of the decoded images.
        truth: Reference poses, or None.
    """

    def __init__(self, file: Path, camera: Intrinsics, truth: Trajectory | None) -> None:
        from semcast.server.view.rerun_viewer import RerunStream  # loads rerun

        self._quality = ViewSettings().jpeg_quality
        self._scene, self._cursor = Scene(truth), Cursor()
        self._stream = RerunStream(
            recording_id="latency", camera=camera, has_truth=truth is not None, has_confidence=True, file=file
        )

    def __call__(
        self, frame: DecodedFrame, result: FrameResult, row: FrameRow, update: MapUpdate | None
    ) -> None:
        """Show a frame and add the stage ``view`` to its row."""
        since = time.perf_counter_ns()
        view = frame_view(frame, result, row, {})
        if update is not None:
            self._scene.update(update)
        self._scene.add_frame(view.without_image())
        self._scene.set_picture(compress_picture(view, self._quality))
        self._stream.write(self._scene.changes_since(self._cursor))
        row.stage_ms["view"] = (time.perf_counter_ns() - since) * 1e-6

    def close(self) -> None:
        """Finish the recording."""
        self._stream.close()


def stage_profile(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the profile of frames, each with its ``stage_ms``.

    Returns:
        ``stages``: stage -> ``p50``, ``p95``, ``max`` in ms over the frames in which it ran, ``ran_share`` of
        frames, ``mean_per_frame_ms`` over all frames and its ``time_share`` of all; ``bottleneck``: the
        stage with the largest mean.

    Raises:
        ValueError: There is no frame.
    """
    if not rows:
        raise ValueError("rows must hold at least one frame")
    stages = list(dict.fromkeys(stage for row in rows for stage in row["stage_ms"]))
    times = {s: np.array([row["stage_ms"][s] for row in rows if s in row["stage_ms"]]) for s in stages}
    total_ms = sum(float(t.sum()) for t in times.values())
    profile = {
        stage: {
            **(duration_percentiles(t) or {}),
            "ran_share": len(t) / len(rows),
            "mean_per_frame_ms": float(t.sum()) / len(rows),
            "time_share": float(t.sum()) / total_ms if total_ms > 0 else 0.0,
        }
        for stage, t in times.items()
    }
    return {"stages": profile, "bottleneck": max(profile, key=lambda s: profile[s]["mean_per_frame_ms"])}


def evaluate_latency(settings: LatencySettings, codec: Codec | None = None) -> dict[str, Any]:
    """Time every stage of the whole path in one process: encode to view, bundle adjustment in line.

    Args:
        settings: What to run.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        Provenance, image size, ``num_frames`` counted, and ``stage_profile``.

    Raises:
        SourceError: The recording can't be read.
        ConfigError: The codec is unknown, or no frame is left behind the warm-up.
    """
    settings = naming(settings, codec)
    sequence, codec = open_stream(settings, codec)
    chosen = select_frames(sequence, settings)
    frames = FrameRun(
        sequence,
        chosen.ids,
        codec,
        settings.the_link,
        settings.seed,
        cache_bytes=0,
    )
    truth = sequence.groundtruth()
    with tempfile.TemporaryDirectory(prefix="semcast-") as folder:
        view = ViewStage(Path(folder) / "run.rrd", sequence.intrinsics, truth)
        try:
            run = reconstruct(frames, sequence.intrinsics, settings.estimation, truth, view)
        finally:
            view.close()
    rows = run.rows[settings.warmup :]
    if not run.rows:
        level = snr_label(settings.snr_db[0], settings.link)
        raise ConfigError(f"no frame was received at {level}: there is nothing to time")
    if not rows:
        raise ConfigError(f"warmup must leave frames to time, got {settings.warmup} of {len(run.rows)}")
    report = {
        **provenance(VERB, settings),
        "sequence": sequence.name,
        "image_wh": [sequence.intrinsics.width, sequence.intrinsics.height],
        "num_frames": len(rows),
        "frames_left_out": chosen.left_out,
        "completeness": run.summary["completeness"],
        **stage_profile(rows),
    }
    return write_result(settings.json, report)
