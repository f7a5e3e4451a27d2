"""Reconstruct the frames of one run: tracking, mapping and bundle adjustment in this thread."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.image import psnr_db
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import ate, match_times
from semcast.evaluation.live_poses import LivePose, live_figures
from semcast.evaluation.pipeline import LinkedFrame
from semcast.server.decoder import tracker_frame
from semcast.server.frame_rows import FrameRow
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.bundle_problem import BundleProblem
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate
from semcast.server.run_results import results_of
from semcast.server.run_summary import summarise
from semcast.server.sent_frames import stretches

#: Called after each processed frame; may add stages of its own to the row's ``stage_ms``.
FrameHook = Callable[[DecodedFrame, FrameResult, FrameRow, MapUpdate | None], None]

#: Stages of the reconstruction that may ask for an adjustment, which then runs within them.
_BUNDLE_HOLDERS = ("map", "two_view", "relocalise")
#: Stages that don't count towards a pose's age: before the receiver, of another process, or after the pose.
_NOT_BEFORE_POSE = frozenset({"encode", "channel", "bundle", "map"})


class TimedBundle(InlineBundle):
    """Adjusts in line and remembers for how long, so that the stage around it can be told from it."""

    def __init__(self) -> None:
        super().__init__()
        self._elapsed_ms = 0.0

    def submit(self, problem: BundleProblem) -> bool:
        """Adjust now."""
        since = time.perf_counter_ns()
        taken = super().submit(problem)
        self._elapsed_ms += (time.perf_counter_ns() - since) * 1e-6
        return taken

    def pop_elapsed_ms(self) -> float:
        """Return the time spent since the last call."""
        elapsed_ms, self._elapsed_ms = self._elapsed_ms, 0.0
        return elapsed_ms


@dataclass(frozen=True)
class ReconstructedRun:
    """What came out of one pass over the frames.

    Attributes:
        summary: The figures ``semcast demo`` reports, ``ate_rmse_m``, ``stage_ms`` and so on, which are of
            the path after all corrections, and those of ``live_figures``.
        rows: One mapping per frame that reached the tracker, with ``error_m`` after alignment where known,
            metres included.
        trajectory: All posed frames in the map's frame and unit.
        num_landmarks: Landmarks at the end.
        truth: Reference poses of the frames that were sent, or None.
    """

    summary: dict[str, Any]
    rows: list[dict[str, Any]]
    trajectory: Trajectory
    num_landmarks: int
    truth: Trajectory | None


def as_received(frame: LinkedFrame) -> DecodedFrame:
    """Return what the server's decoder makes of a frame.

    Raises:
        ValueError: Nothing of it arrived.
    """
    decoded = frame.decoded
    if decoded is None:
        raise ValueError(f"frame {frame.frame_id} did not arrive")
    return tracker_frame(decoded, frame.frame_id, frame.t_source_ns, frame.row_snr_db)


def reconstruct(
    frames: Iterable[LinkedFrame],
    camera: Intrinsics,
    settings: ReconstructionSettings,
    truth: Trajectory | None,
    on_frame: FrameHook | None = None,
) -> ReconstructedRun:
    """Feed received frames to the server's reconstruction and sum up.

    Frames that were lost, or of which nothing usable arrived, never reach the tracker; they count against
    completeness.

    Args:
        frames: Frames in order.
        camera: Camera of the decoded images, without distortion.
        settings: How to reconstruct.
        truth: Reference poses, or None.
        on_frame: Sees each processed frame, such as a viewer.
    """
    rows: list[FrameRow] = []
    frame_times_ns: dict[int, int] = {}
    published: dict[int, LivePose] = {}
    num_lost = 0
    bundle = TimedBundle()
    reconstruction = Reconstruction(camera, settings, bundle)
    try:
        for frame in frames:
            frame_times_ns[frame.frame_id] = frame.t_source_ns
            if frame.decoded is None:
                num_lost += 1
                continue
            row, pose = _process(reconstruction, bundle, frame, on_frame)
            rows.append(row)
            if pose is not None:
                published[frame.frame_id] = pose
        reconstruction.conclude()
        found = results_of(reconstruction, frame_times_ns)
    finally:
        reconstruction.close()
    truth = cut_to_frames(truth, frame_times_ns) if truth is not None else None
    drops = {"lost": num_lost} if num_lost else {}
    sent = stretches({frame_id: k for k, frame_id in enumerate(frame_times_ns)})
    summary = summarise(
        rows, found.trajectory, found.part_of, truth, sent, len(sent), drops, found.num_keyframes
    )
    summary |= live_figures(published, frame_times_ns, truth, summary["frames"]["sent"])
    summary["readout_ms"] = reconstruction.camera.readout_ms
    summary["readout_from"] = reconstruction.camera.readout_from
    plain_rows = _plain_rows(rows, found.trajectory, truth)
    return ReconstructedRun(summary, plain_rows, found.trajectory, found.num_landmarks, truth)


def _process(
    reconstruction: Reconstruction, bundle: TimedBundle, frame: LinkedFrame, on_frame: FrameHook | None
) -> tuple[FrameRow, LivePose | None]:
    """Return the row of a frame and the pose that is published for it, None without one."""
    decoded = frame.decoded
    assert decoded is not None
    received = as_received(frame)
    result = reconstruction.process(received)
    stage_ms = {**frame.stage_ms, **split_bundle(result.stage_ms, bundle.pop_elapsed_ms())}
    row = FrameRow.of(
        received,
        result,
        snr_set_db=None,
        snr_estimated_db=frame.snr_db_estimate,
        # A clean original equals itself: that says nothing about a codec.
        psnr_db=None if frame.row_snr_db is None else psnr_db(frame.original, decoded.image),
        age_ms=sum(ms for stage, ms in stage_ms.items() if stage not in _NOT_BEFORE_POSE),
        stage_ms=stage_ms,
    )
    if on_frame is not None:
        on_frame(received, result, row, reconstruction.take_map_update())
    T_world_cam = result.T_world_cam
    return row, None if T_world_cam is None else LivePose(T_world_cam.copy(), result.covariance)


def split_bundle(stage_ms: Mapping[str, float], bundle_ms: float) -> dict[str, float]:
    """Take an adjustment that ran in line out of the stage that asked for it.

    In the live system it runs in a process of its own; here stages stay comparable with it and don't overlap.

    Args:
        stage_ms: As the reconstruction reports them; its ``bundle`` is that of an earlier frame.
        bundle_ms: Time the adjustment took within this frame, 0 for none.
    """
    split = {stage: ms for stage, ms in stage_ms.items() if stage != "bundle"}
    if bundle_ms > 0.0:
        holder = max(_BUNDLE_HOLDERS, key=lambda stage: split.get(stage, 0.0))
        split[holder] = max(0.0, split.get(holder, 0.0) - bundle_ms)
        split["bundle"] = bundle_ms
    return split


def cut_to_frames(truth: Trajectory, frame_times_ns: dict[int, int]) -> Trajectory:
    """Return the true poses of the frames that were sent: the path that errors are a percentage of."""
    times_s = np.array(sorted(frame_times_ns.values()), dtype=np.float64) * 1e-9
    _, kept = match_times(times_s, truth.t_s)
    return replace(truth, t_s=truth.t_s[kept], T_world_cam=truth.T_world_cam[kept], times_ns=None)


def _plain_rows(
    rows: list[FrameRow], trajectory: Trajectory, truth: Trajectory | None
) -> list[dict[str, Any]]:
    absolute = ate(trajectory, truth) if truth is not None else None
    is_known = absolute is not None and absolute.in_metres
    error_m = dict(zip(absolute.t_s, absolute.error, strict=True)) if absolute and is_known else {}
    return [{**vars(row), "error_m": error_m.get(row.t_source_ns * 1e-9)} for row in rows]
