"""A camera's focal length, distortion and principal point, from its images alone: self-calibration.

The images are reconstructed with the lens as it is believed to be. What adjustments leave over tells by how
much the focal length, the first radial coefficients and the principal point are wrong; with images of the
better lens it is done again.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SemcastError, SourceError
from semcast.common.sequence import ImageRectifier
from semcast.evaluation.moving_images import (
    NOT_MODELLED,
    CameraEvidence,
    Images,
    ImagesSettings,
    gather_evidence,
    load_images,
)
from semcast.evaluation.report import provenance
from semcast.server.mapping.lens import LensFit, believed_lens
from semcast.server.mapping.readout import Readout

Array = NDArray[np.float64]

#: Steps of the search at most.
_MAX_STEPS = 8
#: Factors on the focal length with which it begins again if the first one leads nowhere.
_FAR_FACTORS = (0.83, 1.2)
#: A smaller change ends the search: of the focal length as a share, of a coefficient, or of the principal
#: point in focal lengths.
_NOTHING = 0.001
#: So does one of fewer standard deviations.
_NOTHING_SIGMAS = 0.5
#: No bounds are closer than this share: reconstructions with nearly the same lens speak for changes that
#: differ by as much.
_MIN_REACH = 0.004
#: The lens is nearly right where changes are no larger than this (units as above);
_NEAR = 0.01
#: up to this factor a reconstruction's error may then grow by chance.
_WORSE = 1.02
#: One step changes the focal length by this share at most.
_MAX_STEP = 0.2
#: Powers of the focal length by which k1, k2, p1, p2, k3 ... k6 grow where the distortion in pixels stays.
_POWERS = (2, 4, 1, 1, 6, 2, 4, 6)
#: An interval of the focal length that reaches further than this share to either side is no answer.
_MAX_REACH = 0.05
_NOT_TOLD = (
    "these images don't tell the focal length, and it matters little for images like them: take some "
    "while the camera moves sideways and turns, near things at different distances"
)


@dataclass(frozen=True)
class Lens:
    """A lens, relative to what it was believed to be.

    Attributes:
        focal: Factor on the focal length.
        radial: ``(k1, k2)``, what is added to the radial coefficients.
        centre: ``(x, y)``, what is added to the principal point, in focal lengths as believed before.
    """

    focal: float = 1.0
    radial: tuple[float, float] = (0.0, 0.0)
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def num_radial(self) -> int:
        """How many radial coefficients, the first ones, are changed."""
        return 2 if self.radial[1] else 1 if self.radial[0] else 0

    def put_on(self, camera: Intrinsics) -> Intrinsics:
        """Return a camera with this lens."""
        known = zip(camera.distortion or (0.0, 0.0, 0.0, 0.0), _POWERS, strict=False)
        k1, k2, *others = (k * self.focal**power for k, power in known)
        distortion = (k1 + self.radial[0], k2 + self.radial[1], *others)
        return replace(
            camera,
            fx=camera.fx * self.focal,
            fy=camera.fy * self.focal,
            cx=camera.cx + self.centre[0] * camera.fx,
            cy=camera.cy + self.centre[1] * camera.fy,
            distortion=distortion if any(distortion) else (),
        )


@dataclass(frozen=True)
class LensTrial:
    """What the reconstruction with one lens left.

    Attributes:
        lens: The lens.
        evidence: What it left.
        change: Of the lens, by which residuals would be less; None where they don't say.
    """

    lens: Lens
    evidence: CameraEvidence
    change: LensFit | None


@dataclass(frozen=True)
class LensEstimate:
    """A lens and how far to trust it.

    Attributes:
        camera: As it was given, of the images as stored, with the lens found.
        focal_reach: Bounds of the focal length, as share of it to either side: those of 95 % of scatter, and
            what errors that are not modelled were seen to add.
        radial_reach: The same of the radial coefficients that were changed, the first ones, absolute.
        centre_reach_px: The same of the principal point, x and y, if it was moved.
        trials: All that were made, in order.
        name: Of the images.
        before: The camera as it was given.
    """

    camera: Intrinsics
    focal_reach: float
    radial_reach: tuple[float, ...]
    centre_reach_px: tuple[float, ...]
    trials: tuple[LensTrial, ...]
    name: str
    before: Intrinsics


def find_lens(settings: ImagesSettings, on_trial: Callable[[LensTrial], None] | None = None) -> LensEstimate:
    """Find focal length, radial distortion and principal point of the camera that took some images.

    A distortion that is known is kept, in pixels, and its radial coefficients are added to.

    Args:
        settings: Which images, and the camera to begin with; a quarter of its focal length is far away.
        on_trial: Sees each trial as soon as it is made.

    Raises:
        SourceError: Images or intrinsics can't be read.
        SemcastError: The images don't tell.
    """
    images = load_images(settings)
    if images.stored.distortion_model != "radtan":
        raise SourceError(
            f"the camera of {images.name} must be a pinhole with radial-tangential distortion, got "
            f"{images.stored.distortion_model}: a fisheye is calibrated with a chessboard (semcast calibrate)"
        )
    readout = Readout.of(images.stored)
    trials: list[LensTrial] = []

    def tried(lens: Lens) -> LensTrial:
        trials.append(_tried(images, lens, readout))
        if on_trial is not None:
            on_trial(trials[-1])
        return trials[-1]

    best, num_steps = tried(Lens()), 0
    while True:
        best.evidence.check(images)
        if (change := best.change) is None:
            raise SemcastError(_NOT_TOLD)
        reaches = _reaches(best.evidence, change)
        if _is_nothing(change):
            break
        if num_steps == _MAX_STEPS:
            reaches = np.maximum(reaches, np.abs(_values(change)))
            break
        is_near = np.abs(_values(change)).max() <= _NEAR
        most_px = (_WORSE if is_near else 1.0) * best.evidence.mean_px
        trial = tried(_changed(best.lens, change))
        if trial.evidence.mean_px > most_px and not is_near:
            # Adjustments are straight lines only nearby.
            trial = tried(_changed(best.lens, _half(change)))
        if trial.evidence.mean_px > most_px:
            # Residuals and the reconstruction contradict each other by so much.
            if num_steps or abs(change.focal) <= reaches[0]:
                reaches = np.maximum(reaches, np.abs(_values(change)))
                break
            # From too far away they do altogether.
            trial = min((tried(Lens(f)) for f in _FAR_FACTORS), key=lambda t: t.evidence.mean_px)
            if trial.evidence.mean_px > most_px:
                raise SemcastError(_NOT_TOLD)
        best, num_steps = trial, num_steps + 1
    reaches += np.sqrt(NOT_MODELLED) * np.array(change.unit)
    if reaches[0] > _MAX_REACH:
        raise SemcastError(_NOT_TOLD)
    camera = best.lens.put_on(images.stored)
    return LensEstimate(
        camera,
        float(reaches[0]),
        tuple(reaches[1 : 1 + best.lens.num_radial].tolist()),
        tuple((reaches[3:] * (camera.fx, camera.fy)).tolist()) if any(best.lens.centre) else (),
        tuple(trials),
        images.name,
        images.stored,
    )


def _values(change: LensFit) -> Array:
    """Return ``(5,)``: focal length, radial coefficients, principal point."""
    return np.array([change.focal, *change.radial, *change.centre])


def _sigmas(change: LensFit) -> Array:
    return np.array([change.sigma_focal, *change.sigma_radial, *change.sigma_centre])


def _reaches(evidence: CameraEvidence, change: LensFit) -> Array:
    """Return the bounds of 95 % of scatter, ``(5,)``, to either side."""
    reaches = np.array([evidence.reach_95(sigma) for sigma in _sigmas(change)])
    reaches[0] = max(reaches[0], _MIN_REACH)
    return reaches


def _is_nothing(change: LensFit) -> bool:
    return bool((np.abs(_values(change)) < np.maximum(_NOTHING, _NOTHING_SIGMAS * _sigmas(change))).all())


def _half(change: LensFit) -> LensFit:
    (k1, k2), (x, y) = change.radial, change.centre
    return replace(change, focal=0.5 * change.focal, radial=(0.5 * k1, 0.5 * k2), centre=(0.5 * x, 0.5 * y))


def _changed(lens: Lens, change: LensFit) -> Lens:
    factor = 1.0 + float(np.clip(change.focal, -_MAX_STEP, _MAX_STEP))
    # In pixels distortion and principal point stay what they are, whatever the focal length.
    (k1, k2), (more_k1, more_k2) = lens.radial, change.radial
    (x, y), (more_x, more_y) = lens.centre, change.centre
    return Lens(
        lens.focal * factor,
        ((k1 + more_k1) * factor**2, (k2 + more_k2) * factor**4),
        (x + more_x * lens.focal, y + more_y * lens.focal),
    )


def _tried(images: Images, lens: Lens, readout: Readout) -> LensTrial:
    """Reconstruct with one lens."""
    camera = lens.put_on(images.camera)
    rectify = ImageRectifier(camera, (camera.width, camera.height))
    frames = [replace(frame, image=rectify(frame.image)) for frame in images.frames]
    evidence = gather_evidence(frames, camera, readout)
    # What is once believed to be there is asked for to the end.
    return LensTrial(lens, evidence, believed_lens(evidence.views, lens.num_radial, any(lens.centre)))


def lens_report(settings: ImagesSettings, found: LensEstimate) -> dict[str, Any]:
    """Return the result with its provenance, for ``write_result``."""
    return {
        **provenance("lens", settings),
        "sequence": found.name,
        "before": found.before.to_dict(),
        "found": found.camera.to_dict(),
        "focal_reach": found.focal_reach,
        "radial_reach": found.radial_reach,
        "centre_reach_px": found.centre_reach_px,
        "trials": [
            {
                "focal": trial.lens.focal,
                "radial": trial.lens.radial,
                "centre": trial.lens.centre,
                "error_px": trial.evidence.mean_px,
                "num_frames": trial.evidence.num_frames,
                "more_focal": None if trial.change is None else trial.change.focal,
                "more_radial": None if trial.change is None else trial.change.radial,
                "more_centre": None if trial.change is None else trial.change.centre,
                "explained": None if trial.change is None else trial.change.explained,
            }
            for trial in found.trials
        ],
    }
