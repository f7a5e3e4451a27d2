"""A rolling shutter's readout time, from images of the camera alone.

The images are reconstructed as if all rows were exposed at once. What adjustments leave over tells the
readout time; with images put right for it, the next reconstruction tells what is left of it, until that is
nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semcast.common.camera import MAX_READOUT_MS, Intrinsics
from semcast.common.errors import SemcastError, SourceError
from semcast.evaluation.moving_images import (
    MIN_FRAMES,
    NOT_MODELLED,
    CameraEvidence,
    Images,
    ImagesSettings,
    gather_evidence,
    load_images,
)
from semcast.evaluation.report import provenance
from semcast.server.mapping.readout import Readout, ReadoutFit, fit_readout

#: Reconstructions at most, and the factor by which each has to make errors smaller for its readout to be
#: believed.
_MAX_TRIALS, _BETTER = 4, 0.995
#: What is left of the readout then counts as nothing.
_NOTHING_MS = 0.3
#: An interval wider than this is no answer.
_MAX_INTERVAL_MS = 10.0
#: Below it a shutter is as good as global: turning by 100 degrees a second leans an image by .1 degree.
_AS_GOOD_AS_GLOBAL_MS = 1.0
_NOT_TOLD = (
    "these images don't tell the readout time, and it matters little for images like them: take some while "
    "the camera turns from side to side and up and down, about 60 degrees a second"
)
#: Images must be further apart than this, for a readout to fit in between.
_LEAST_PERIOD_MS = 5.0


@dataclass(frozen=True)
class Trial:
    """What the reconstruction with one readout time left.

    Attributes:
        readout: The readout time.
        evidence: What it left.
        fit: The readout that residuals speak for, with what was put right; None where they don't say.
    """

    readout: Readout
    evidence: CameraEvidence
    fit: ReadoutFit | None

    @property
    def more_ms(self) -> float:
        """By how much the readout that residuals speak for differs from that of the images."""
        if self.fit is None:
            return 0.0
        known_ms = self.readout.signed_ms if self.readout.axis == self.fit.readout.axis else 0.0
        return self.fit.readout.signed_ms - known_ms


@dataclass(frozen=True)
class ReadoutEstimate:
    """A readout time and how far to trust it.

    Attributes:
        readout: What residuals speak for.
        low_ms: Lower bound of ``signed_ms``: of 95 % of scatter, and beyond it what errors that are not
            modelled were seen to add.
        high_ms: Upper bound.
        camera: As it was given, of the images as stored, with the readout found.
        trials: All that were made, in order.
        name: Of the images.
    """

    readout: Readout
    low_ms: float
    high_ms: float
    camera: Intrinsics
    trials: tuple[Trial, ...]
    name: str

    @property
    def is_global(self) -> bool:
        """Whether the shutter is as good as global."""
        return self.camera.readout_ms == 0.0


def find_readout(
    settings: ImagesSettings, on_trial: Callable[[Trial], None] | None = None
) -> ReadoutEstimate:
    """Find the readout time of the camera that took some images.

    Args:
        settings: Which images.
        on_trial: Sees each trial as soon as it is made.

    Raises:
        SourceError: Images or intrinsics can't be read.
        SemcastError: The images don't tell.
    """
    images = load_images(settings)
    if images.period_ms < _LEAST_PERIOD_MS:
        most_hz = 1e3 / _LEAST_PERIOD_MS
        raise SourceError(
            f"{images.name} must have at most {most_hz:g} images a second, got {1e3 / images.period_ms:.0f}"
        )
    limit_ms = min(images.period_ms, MAX_READOUT_MS)

    def tried(readout: Readout) -> Trial:
        trials.append(trial := _tried(images, readout))
        if on_trial is not None:
            on_trial(trial)
        return trial

    trials: list[Trial] = []
    best, is_wrong = tried(Readout("rows", 0.0)), False
    fit = _checked(best, images)
    while abs(best.more_ms) >= max(_NOTHING_MS, fit.sigma_ms) and len(trials) < _MAX_TRIALS:
        trial = tried(_within(fit.readout, limit_ms))
        # Residuals have other causes, which speak for a readout too.
        is_better = trial.evidence.mean_px < _BETTER * best.evidence.mean_px
        if trial.evidence.num_frames < MIN_FRAMES or not is_better:
            is_wrong = best.readout.ms == 0.0
            break
        best, fit = trial, _checked(trial, images)
    readout, reach_ms = _within(fit.readout, limit_ms), best.evidence.reach_95(fit.sigma_ms)
    reach_ms += np.sqrt(NOT_MODELLED) * fit.unit_ms
    if is_wrong:
        readout, reach_ms = best.readout, max(reach_ms, fit.readout.ms)
    low_ms, high_ms = readout.signed_ms - reach_ms, readout.signed_ms + reach_ms
    if high_ms - low_ms > _MAX_INTERVAL_MS:
        raise SemcastError(_NOT_TOLD)
    is_global = bool(low_ms <= 0.0 <= high_ms or readout.ms < _AS_GOOD_AS_GLOBAL_MS)
    found = replace(
        images.stored,
        readout_ms=0.0 if is_global else round(readout.ms, 1),
        readout_from="top" if is_global else readout.side,
    )
    return ReadoutEstimate(readout, low_ms, high_ms, found, tuple(trials), images.name)


def readout_report(settings: ImagesSettings, estimate: ReadoutEstimate) -> dict[str, Any]:
    """Return the result with its provenance, for ``write_result``."""
    return {
        **provenance("shutter", settings),
        "sequence": estimate.name,
        "readout_ms": estimate.camera.readout_ms,
        "readout_from": estimate.camera.readout_from,
        "axis": estimate.readout.axis,
        "least_ms": estimate.readout.signed_ms,
        "interval_ms": [estimate.low_ms, estimate.high_ms],
        "trials": [
            {
                "axis": trial.readout.axis,
                "signed_ms": trial.readout.signed_ms,
                "error_px": trial.evidence.mean_px,
                "num_frames": trial.evidence.num_frames,
                "more_axis": None if trial.fit is None else trial.fit.readout.axis,
                "more_ms": None if trial.fit is None else trial.more_ms,
                "sigma_ms": None if trial.fit is None else trial.fit.sigma_ms,
                "explained": None if trial.fit is None else trial.fit.explained,
            }
            for trial in estimate.trials
        ],
    }


def _within(readout: Readout, limit_ms: float) -> Readout:
    """Return a readout that is no longer than a limit."""
    return replace(readout, signed_ms=float(np.clip(readout.signed_ms, -limit_ms, limit_ms)))


def _checked(trial: Trial, images: Images) -> ReadoutFit:
    """Return what a trial says.

    Raises:
        SemcastError: Too few frames got a pose, or they say nothing.
    """
    trial.evidence.check(images)
    if trial.fit is None:
        raise SemcastError(_NOT_TOLD)
    return trial.fit


def _tried(images: Images, readout: Readout) -> Trial:
    """Reconstruct with one readout time."""
    evidence = gather_evidence(images.frames, images.camera, readout)
    return Trial(readout, evidence, fit_readout(evidence.views, readout.axis if readout.ms else None))
