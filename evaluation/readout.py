"""A rolling shutter's readout time, from images of the camera alone.

The images are reconstructed over and over, each time put right for another readout time. The right one leaves
the smallest reprojection error: rows that are given a wrong time lean against the others.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semcast.agent.source import Source, open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.camera import MAX_READOUT_MS, Intrinsics, ReadoutFrom
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SemcastError, SourceError
from semcast.common.sequence import resized
from semcast.common.sequence_layouts import Layout
from semcast.evaluation.report import provenance, write_json
from semcast.evaluation.statistics import MIN_SAMPLES, small_sample_factor
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame

Array = NDArray[np.float64]
#: Rows are read from top or bottom, columns (of an upright phone) from left or right.
Axis = Literal["rows", "columns"]

_SIDES: dict[Axis, tuple[ReadoutFrom, ReadoutFrom]] = {
    "rows": ("top", "bottom"),
    "columns": ("left", "right"),
}
#: The search walks in these steps, each as far as the error falls.
_STEPS_MS = (10.0, 5.0, 2.5)
#: Trials that far from the best one are fitted.
_FIT_REACH_MS = 10.0
#: Larger images tell no more and take longer.
_MAX_PIXELS = 640 * 480
#: Frames with a pose in every trial from which there is an answer, and those that are resampled together.
_MIN_FRAMES, _BLOCK_FRAMES = 30, 10
_NUM_RESAMPLES = 1000
#: An interval wider than this is no answer.
_MAX_INTERVAL_MS = 10.0
#: Below it a shutter is as good as global: turning by 100 degrees a second leans an image by .1 degree.
_AS_GOOD_AS_GLOBAL_MS = 1.0


@dataclass(frozen=True, kw_only=True)
class ReadoutSettings:
    """Settings of ``find_readout``.

    Raises:
        ValueError: A value is out of range.
    """

    source: str = field(
        metadata={
            "positional": True,
            "help": "video, folder of a recorded sequence or of images, or number of a camera, which is then "
            "to be moved and turned",
        }
    )
    layout: Layout = field(
        default="auto",
        metadata={"help": "layout of the folder: native, tum, kitti, euroc, transforms, folder"},
    )
    camera: CameraSettings = field(default=CameraSettings(), metadata={"help": "intrinsics"})
    rate_hz: float | None = field(
        default=None, metadata={"help": "frames per second of folders that record no times"}
    )
    frames: int = field(default=150, metadata={"help": "frames used at most, from the first one on"})
    json: Path | None = field(default=None, metadata={"help": "file for the result"})

    def __post_init__(self) -> None:
        if not _MIN_FRAMES < self.frames <= 1000:
            raise ValueError(f"frames must be in [{_MIN_FRAMES + 1}, 1000], got {self.frames}")


@dataclass(frozen=True, order=True)
class Readout:
    """A readout time with its direction.

    Attributes:
        axis: What is read one after the other.
        signed_ms: From the first to the last; below 0 from the last to the first.
    """

    axis: Axis
    signed_ms: float

    @property
    def ms(self) -> float:
        """Time from the first row or column that is read to the last."""
        return abs(self.signed_ms)

    @property
    def side(self) -> ReadoutFrom:
        """Where it begins."""
        return _SIDES[self.axis][self.signed_ms < 0]

    def __str__(self) -> str:
        return f"{self.ms:.1f} ms from {self.side}"


@dataclass(frozen=True)
class Trial:
    """What the reconstruction with one readout time left.

    Attributes:
        readout: The readout time.
        error_px: Median reprojection error of each frame that got a pose, by frame id.
    """

    readout: Readout
    error_px: dict[int, float]

    @property
    def mean_px(self) -> float:
        """Mean over the frames, infinite without any."""
        return float(np.mean(list(self.error_px.values()))) if self.error_px else np.inf


@dataclass(frozen=True)
class ReadoutEstimate:
    """A readout time and how far to trust it.

    Attributes:
        readout: Where the error is least.
        low_ms: Lower bound of ``signed_ms``, 95 %, frames resampled in blocks, widened for how few those are.
        high_ms: Upper bound.
        camera: As it was given, of the images as stored, with the readout found.
        trials: All that were made, in order.
    """

    readout: Readout
    low_ms: float
    high_ms: float
    camera: Intrinsics
    trials: tuple[Trial, ...]

    @property
    def is_global(self) -> bool:
        """Whether the shutter is as good as global."""
        return self.camera.readout_ms == 0.0


def find_readout(
    settings: ReadoutSettings, on_trial: Callable[[Trial], None] | None = None
) -> ReadoutEstimate:
    """Find the readout time of the camera that took some images.

    Args:
        settings: Which images.
        on_trial: Sees each trial as soon as it is made.

    Raises:
        SourceError: Images or intrinsics can't be read.
        SemcastError: The images don't tell, or the result can't be written.
    """
    source = open_source(
        SourceSettings(
            source=settings.source,
            layout=settings.layout,
            camera=settings.camera,
            rate_hz=settings.rate_hz,
            max_frames=settings.frames,
            pace="receiver",
        )
    )
    try:
        frames, camera = _small_frames(source)
        stored = source.stored_camera
    finally:
        source.close()
    if len(frames) <= _MIN_FRAMES:
        raise SourceError(f"{source.name} must have more than {_MIN_FRAMES} images, got {len(frames)}")
    period_ms = float(np.median(np.diff([frame.t_source_ns for frame in frames]))) * 1e-6
    if period_ms < _STEPS_MS[1]:
        most_hz = 1e3 / _STEPS_MS[1]
        raise SourceError(
            f"{source.name} must have at most {most_hz:g} images a second, got {1e3 / period_ms:.0f}"
        )
    trials: dict[Readout, Trial] = {}

    def error_px(readout: Readout) -> float:
        if readout not in trials:
            trials[readout] = trial = _tried(frames, camera, readout)
            if on_trial is not None:
                on_trial(trial)
        # Where the camera was mostly lost, the few frames with a pose are the easy ones.
        is_lost = 2 * len(trials[readout].error_px) < len(frames)
        return np.inf if is_lost else trials[readout].mean_px

    best = search(error_px, min(period_ms, MAX_READOUT_MS))
    readout, low_ms, high_ms = fitted(best, tuple(trials.values()))
    is_global = bool(low_ms <= 0.0 <= high_ms or readout.ms < _AS_GOOD_AS_GLOBAL_MS)
    found = replace(
        stored,
        readout_ms=0.0 if is_global else round(readout.ms, 1),
        readout_from="top" if is_global else readout.side,
    )
    estimate = ReadoutEstimate(readout, low_ms, high_ms, found, tuple(trials.values()))
    if settings.json is not None:
        write_json(settings.json, _report(settings, source.name, estimate))
    return estimate


def _report(settings: ReadoutSettings, name: str, estimate: ReadoutEstimate) -> dict[str, Any]:
    """Return the result with its provenance."""
    return {
        **provenance("shutter", settings),
        "sequence": name,
        "readout_ms": estimate.camera.readout_ms,
        "readout_from": estimate.camera.readout_from,
        "axis": estimate.readout.axis,
        "least_ms": estimate.readout.signed_ms,
        "interval_ms": [estimate.low_ms, estimate.high_ms],
        "trials": [
            {
                "axis": trial.readout.axis,
                "signed_ms": trial.readout.signed_ms,
                "error_px": trial.mean_px if trial.error_px else None,
                "num_frames": len(trial.error_px),
            }
            for trial in estimate.trials
        ],
    }


def search(error_px: Callable[[Readout], float], limit_ms: float) -> Readout:
    """Return the readout time with the least error, to the last step of the search.

    Args:
        error_px: Error of a readout time.
        limit_ms: No readout takes longer; the time between two frames at most.
    """
    best = Readout("rows", 0.0)
    for step_ms in _STEPS_MS:
        while True:
            axes: Sequence[Axis] = (best.axis,) if best.signed_ms else ("rows", "columns")
            beside = [
                Readout(axis if best.signed_ms + way else "rows", best.signed_ms + way)
                for axis in axes
                for way in (-step_ms, step_ms)
                if abs(best.signed_ms + way) <= limit_ms
            ]
            nearest = min(beside, key=error_px, default=best)
            if error_px(nearest) >= error_px(best):
                break
            best = nearest
    return best


def fitted(best: Readout, trials: Sequence[Trial]) -> tuple[Readout, float, float]:
    """Return the readout time with the least error between the trials, and the bounds of ``signed_ms``.

    Noise and lean add up as squares, and the lean grows in proportion to how wrong the time is: the square of
    the error is a parabola. No trial of 0 is fitted: images that are left as they are keep the sharpness that
    putting them right costs. The longer the readout, the more the movement's own errors cost: the least is
    some percent short of the true time, and the better one to put images right by.

    Args:
        best: As found by ``search``.
        trials: All of them.

    Raises:
        SemcastError: Too few frames have poses, or the least is no clear one.
    """
    if not best.signed_ms:
        best = min((t for t in trials if t.readout.ms), key=lambda t: t.mean_px).readout
        best = Readout(best.axis, 0.0)
    used = [
        trial
        for trial in trials
        if trial.readout.ms
        and trial.readout.axis == best.axis
        and abs(trial.readout.signed_ms - best.signed_ms) <= _FIT_REACH_MS
    ]
    ids = sorted(set[int].intersection(*(set(trial.error_px) for trial in used))) if used else []
    if len(ids) < _MIN_FRAMES:
        raise SemcastError(
            f"only {len(ids)} frames got a pose in every trial, {_MIN_FRAMES} are needed: take images of a "
            "place with much to see, while the camera moves sideways and turns"
        )
    at_ms = np.array([trial.readout.signed_ms for trial in used])
    errors_px = np.array([[trial.error_px[k] for k in ids] for trial in used])
    rng = np.random.default_rng(0)
    starts = rng.integers(len(ids), size=(_NUM_RESAMPLES, -(-len(ids) // _BLOCK_FRAMES), 1))
    blocks = ((starts + np.arange(_BLOCK_FRAMES)) % len(ids)).reshape(_NUM_RESAMPLES, -1)[:, : len(ids)]
    resampled = errors_px[:, blocks].mean(axis=2)
    bend, least_ms = _parabolas(at_ms, np.column_stack([errors_px.mean(axis=1), resampled]) ** 2)
    # Fewer than five blocks count as five: with them the interval is still a little too narrow.
    widen = small_sample_factor(max(MIN_SAMPLES, len(ids) // _BLOCK_FRAMES))
    low_ms, high_ms = least_ms[0] + widen * (np.percentile(least_ms[1:], (2.5, 97.5)) - least_ms[0])
    if np.mean(bend <= 0) > 0.025 or bend[0] <= 0 or high_ms - low_ms > _MAX_INTERVAL_MS:
        raise SemcastError(
            "these images don't tell the readout time, and it matters little for images like them: take some "
            "while the camera turns from side to side and up and down, about 60 degrees a second"
        )
    return Readout(best.axis, float(least_ms[0])), float(low_ms), float(high_ms)


def _parabolas(x: Array, y: Array) -> tuple[Array, Array]:
    """Fit a parabola to each column of ``(N, M)`` over ``(N,)``; bend and place of the least of each."""
    middle = x.mean()
    _, slope, bend = np.linalg.lstsq(np.vander(x - middle, 3, increasing=True), y, rcond=None)[0]
    return bend, middle - 0.5 * slope / np.where(bend == 0, np.nan, bend)


def _small_frames(source: Source) -> tuple[list[DecodedFrame], Intrinsics]:
    """Return the frames of a source, made small, and their camera."""
    camera = source.intrinsics
    share = min(1.0, float(np.sqrt(_MAX_PIXELS / (camera.width * camera.height))))
    camera = camera.scaled_to(round(camera.width * share), round(camera.height * share))
    frames = [
        DecodedFrame(frame.frame_id, frame.t_source_ns, resized(frame.image, (camera.width, camera.height)))
        for frame in source.frames(threading.Event())
    ]
    return frames, camera


def _tried(frames: Sequence[DecodedFrame], camera: Intrinsics, readout: Readout) -> Trial:
    """Reconstruct with one readout time."""
    settings = ReconstructionSettings(confidence="off", readout_ms=readout.ms, readout_from=readout.side)
    reconstruction = Reconstruction(camera, settings, InlineBundle())
    try:
        results = [reconstruction.process(frame) for frame in frames]
    finally:
        reconstruction.close()
    errors_px = {r.frame_id: r.reprojection_error_px for r in results}
    return Trial(readout, {k: error for k, error in errors_px.items() if error is not None})
