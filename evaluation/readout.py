"""A rolling shutter's readout time, from images of the camera alone.

The images are reconstructed as if all rows were exposed at once. What adjustments leave over tells the
readout time (``server/mapping/readout.py``); with images put right for it, the next reconstruction tells what
is left of it, until that is nothing.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.agent.source import Source, open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.camera import MAX_READOUT_MS, Intrinsics
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SemcastError, SourceError
from semcast.common.sequence import resized
from semcast.common.sequence_layouts import Layout
from semcast.evaluation.report import provenance, write_json
from semcast.evaluation.statistics import small_sample_factor
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult
from semcast.server.mapping.readout import NUM_GROUPS, Readout, ReadoutFit, fit_readout
from semcast.server.mapping.readout_watch import ReadoutWatch
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]

#: Reconstructions at most, and the factor by which each has to make errors smaller for its readout to be
#: believed.
_MAX_TRIALS, _BETTER = 4, 0.995
#: What is left of the readout then counts as nothing.
_NOTHING_MS = 0.3
#: Larger images tell no more and take longer.
_MAX_PIXELS = 640 * 480
#: Frames with a pose from which there is an answer.
_MIN_FRAMES = 30
#: An interval wider than this is no answer.
_MAX_INTERVAL_MS = 10.0
#: Standard deviations either side of 95 %.
_SIGMAS_95 = 1.96
#: Below it a shutter is as good as global: turning by 100 degrees a second leans an image by .1 degree.
_AS_GOOD_AS_GLOBAL_MS = 1.0
_NOT_TOLD = (
    "these images don't tell the readout time, and it matters little for images like them: take some while "
    "the camera turns from side to side and up and down, about 60 degrees a second"
)
#: Images must be further apart than this, for a readout to fit in between.
_LEAST_PERIOD_MS = 5.0


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


@dataclass(frozen=True)
class Trial:
    """What the reconstruction with one readout time left.

    Attributes:
        readout: The readout time.
        mean_px: Mean over frames of their median reprojection error, infinite without any.
        num_frames: Frames that got a pose.
        more: By how much more readout residuals would be less, None where they don't say.
    """

    readout: Readout
    mean_px: float
    num_frames: int
    more: ReadoutFit | None


@dataclass(frozen=True)
class ReadoutEstimate:
    """A readout time and how far to trust it.

    Attributes:
        readout: That images are best put right for.
        low_ms: Lower bound of ``signed_ms``, 95 %, by leaving out a part of the keyframes at a time.
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
    if period_ms < _LEAST_PERIOD_MS:
        most_hz = 1e3 / _LEAST_PERIOD_MS
        raise SourceError(
            f"{source.name} must have at most {most_hz:g} images a second, got {1e3 / period_ms:.0f}"
        )
    trials = [_seen(_tried(frames, camera, Readout("rows", 0.0)), on_trial)]
    more = _checked(trials[0])
    readout, sigma_ms = Readout("rows", 0.0), more.sigma_ms
    while more.readout.ms >= max(_NOTHING_MS, more.sigma_ms) and len(trials) < _MAX_TRIALS:
        longer = readout.with_more(more.readout)
        longer = replace(longer, signed_ms=_bounded(longer.signed_ms, min(period_ms, MAX_READOUT_MS)))
        trial = _seen(_tried(frames, camera, longer), on_trial)
        # Putting images right has errors of its own, which speak for a readout too.
        is_better = trial.num_frames >= _MIN_FRAMES and trial.mean_px < _BETTER * trials[-1].mean_px
        trials.append(trial)
        if not is_better:
            break
        readout, sigma_ms = longer, more.sigma_ms
        more = _checked(trial)
    # So many groups of keyframes tell how sure it is.
    reach_ms = _SIGMAS_95 * small_sample_factor(NUM_GROUPS) * sigma_ms
    low_ms, high_ms = readout.signed_ms - reach_ms, readout.signed_ms + reach_ms
    if high_ms - low_ms > _MAX_INTERVAL_MS:
        raise SemcastError(_NOT_TOLD)
    is_global = bool(low_ms <= 0.0 <= high_ms or readout.ms < _AS_GOOD_AS_GLOBAL_MS)
    found = replace(
        stored,
        readout_ms=0.0 if is_global else round(readout.ms, 1),
        readout_from="top" if is_global else readout.side,
    )
    estimate = ReadoutEstimate(readout, low_ms, high_ms, found, tuple(trials))
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
                "error_px": trial.mean_px if trial.num_frames else None,
                "num_frames": trial.num_frames,
                "more_axis": None if trial.more is None else trial.more.readout.axis,
                "more_ms": None if trial.more is None else trial.more.readout.signed_ms,
                "sigma_ms": None if trial.more is None else trial.more.sigma_ms,
                "explained": None if trial.more is None else trial.more.explained,
            }
            for trial in estimate.trials
        ],
    }


def _seen(trial: Trial, on_trial: Callable[[Trial], None] | None) -> Trial:
    if on_trial is not None:
        on_trial(trial)
    return trial


def _checked(trial: Trial) -> ReadoutFit:
    """Return what a trial says.

    Raises:
        SemcastError: Too few frames got a pose, or they say nothing.
    """
    if trial.num_frames < _MIN_FRAMES:
        raise SemcastError(
            f"only {trial.num_frames} frames got a pose, {_MIN_FRAMES} are needed: take images of a place "
            "with much to see, while the camera moves sideways and turns"
        )
    if trial.more is None:
        raise SemcastError(_NOT_TOLD)
    return trial.more


def _bounded(value: float, limit: float) -> float:
    return float(np.clip(value, -limit, limit))


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


class _Listening(InlineBundle):
    """Asks every few adjustments what their residuals say."""

    def __init__(self, camera: Intrinsics) -> None:
        super().__init__()
        self.watch = ReadoutWatch(camera, is_wanted=True)
        self.world: WorldMap | None = None
        self.views: list[Array] = []

    def submit(self, problem: BundleProblem) -> bool:
        """Adjust now."""
        assert self.world is not None
        return super().submit(replace(problem, motion=self.watch.motion(self.world, problem)))

    def take(self, wait: bool = False) -> BundleResult | None:
        """Return the result of the last ``submit``, once."""
        result = super().take(wait)
        if result is not None and result.readout is not None:
            self.views += list(result.readout)
        return result


def _tried(frames: Sequence[DecodedFrame], camera: Intrinsics, readout: Readout) -> Trial:
    """Reconstruct with one readout time."""
    settings = ReconstructionSettings(confidence="off", readout_ms=readout.ms, readout_from=readout.side)
    bundle = _Listening(camera)
    reconstruction = Reconstruction(camera, settings, bundle)
    errors_px = []
    try:
        for frame in frames:
            bundle.world = reconstruction.world
            result = reconstruction.process(frame)
            for frame_id, t_source_ns, _ in result.backfilled:
                bundle.watch.note(frame_id, t_source_ns)
            if result.T_world_cam is not None:
                bundle.watch.note(frame.frame_id, frame.t_source_ns)
            if result.reprojection_error_px is not None:
                errors_px.append(result.reprojection_error_px)
    finally:
        reconstruction.close()
    more = fit_readout(bundle.views, readout.axis if readout.ms else None)
    return Trial(readout, float(np.mean(errors_px)) if errors_px else np.inf, len(errors_px), more)
