"""Pinhole intrinsics with lens distortion and the shutter's readout.

Pixel centres have integer coordinates: the image spans ``[-0.5, width - 0.5]``.
"""

import json
import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcast.common.errors import SourceError
from semcast.common.lens import DistortionModel, check_distortion, lens_in
from semcast.common.whole_file import write_whole

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: Side of the image that a rolling shutter exposes first.
ReadoutFrom = Literal["top", "bottom", "left", "right"]
#: Time in ms a shutter takes at most; slower ones are no cameras for moving.
MAX_READOUT_MS = 100.0

#: Share of a side by which a principal point may be off the middle; cameras keep within a twentieth, cut
#: images do not.
_MOST_OFF_CENTRE = 0.25
#: Side of an image in focal lengths at most: a view of 2 atan(6), 161 degrees.
_MAX_SIZE_PER_FOCAL = 12.0
#: Focal lengths per longer side from which a view (3 degrees, 690 mm on a 35 mm camera) is hardly meant, and
#: ratio of the two focal lengths: 4:3 taken for 16:9 makes it 1.33, pixels that are not square seldom 1.1.
_MOST_FOCALS_PER_SIZE, _MOST_OBLONG = 19.0, 1.2


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A calibrated camera.

    Attributes:
        fx: Focal length in pixels, horizontal.
        fy: Focal length in pixels, vertical.
        cx: Principal point x in pixels.
        cy: Principal point y in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        distortion: OpenCV coefficients ``k1 k2 p1 p2 [k3 [k4 k5 k6]]``, empty for none; of a fisheye
            ``k1 k2 k3 k4``.
        distortion_model: ``radtan``, or ``equidistant`` for a fisheye, whose image of a point lies
            ``theta (1 + k1 theta^2 + k2 theta^4 + ...)`` focal lengths off the centre, theta being its angle
            to the axis (Kannala and Brandt 2006, as OpenCV has it).
        readout_ms: Time a rolling shutter takes from the first row or column to the last; 0: a global one.
        readout_from: Side of the image it begins at.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    distortion_model: DistortionModel = "radtan"
    readout_ms: float = 0.0
    readout_from: ReadoutFrom = "top"

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: A focal length or a side is not positive, or another value is out of range.
        """
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a positive number of pixels, got {value}")
        for name in ("cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        for name in ("width", "height"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1 pixel, got {getattr(self, name)}")
        check_distortion(self.distortion_model, self.distortion)
        check_readout(self.readout_ms, self.readout_from)

    def check_possible(self, name: str) -> None:
        """Check that a camera can be like that, for those who read what a user gave.

        A principal point far from the middle is warned of, for a calibration for larger images gives one, and
        so are focal lengths that are very long or very different from each other.

        Args:
            name: What the intrinsics belong to, for the message.

        Raises:
            SourceError: The principal point is outside the image, or the view wider than that of a pinhole.
        """
        wrong = f"intrinsics of {name} are not valid"
        for axis, centre, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -0.5 <= centre <= size - 0.5:
                raise SourceError(f"{wrong}: {axis} must be in [-0.5, {size - 0.5}], got {centre:g}")
            if abs(centre + 0.5 - size / 2) > _MOST_OFF_CENTRE * size:
                logger.warning(
                    "%s: %s is %g px in images of %dx%d, far from their middle: is the calibration for "
                    "another image size?",
                    *(name, axis, centre, self.width, self.height),
                )
        for axis, focal_px, size in (("fx", self.fx, self.width), ("fy", self.fy, self.height)):
            least_px = size / _MAX_SIZE_PER_FOCAL
            if focal_px < least_px:
                raise SourceError(
                    f"{wrong}: {axis} must be at least {least_px:.1f} for images of {self.width}x"
                    f"{self.height} (a view of 160 degrees), got {focal_px:g}; focal lengths are in pixels"
                )
        if max(self.fx, self.fy) > _MOST_FOCALS_PER_SIZE * max(self.width, self.height):
            logger.warning(
                "%s: fx %g and fy %g are a view of less than 3 degrees in images of %dx%d: focal lengths are "
                "in pixels of these",
                *(name, self.fx, self.fy, self.width, self.height),
            )
        if max(self.fx / self.fy, self.fy / self.fx) > _MOST_OBLONG:
            logger.warning(
                "%s: fx is %g and fy %g, as of pixels that are far from square: is the calibration for "
                "images of another shape?",
                *(name, self.fx, self.fy),
            )

    @property
    def K(self) -> Array:
        """3x3 calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def shape_hw(self) -> tuple[int, int]:
        """Image height and width in pixels."""
        return self.height, self.width

    @property
    def half_diagonal_rad(self) -> float:
        """Angle from the middle of the view to a corner, taken as if the principal point were the middle."""
        return float(np.arctan(0.5 * np.hypot(self.width / self.fx, self.height / self.fy)))

    def has_shape_of(self, width: int, height: int) -> bool:
        """Whether images of this size have the shape of the camera's, up to a pixel of rounding."""
        return abs(width * self.height - height * self.width) <= max(self.width, width)

    def scaled_to(self, width: int, height: int) -> "Intrinsics":
        """Return the intrinsics of the same image resized to ``width x height``.

        With integer pixel centres a resize maps ``x`` to ``(x + 0.5) * s - 0.5``; the principal point
        follows that, not ``cx * s``.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
        )

    @property
    def is_distorted(self) -> bool:
        """Whether images differ from a pinhole's."""
        return self.distortion_model == "equidistant" or any(self.distortion)

    def undistorted(self) -> "Intrinsics":
        """Return the same pinhole without distortion: the camera of the undistorted image."""
        return replace(self, distortion=(), distortion_model="radtan")

    def project(self, points_cam: ArrayLike) -> Array:
        """Project ``(N, 3)`` points in the camera frame to ``(N, 2)`` pixels, without distortion.

        Points at or behind the camera plane give NaN.
        """
        p = np.asarray(points_cam, dtype=np.float64)
        depth = np.where(p[:, 2] > 0, p[:, 2], np.nan)
        return np.stack([self.fx * p[:, 0] / depth + self.cx, self.fy * p[:, 1] / depth + self.cy], axis=1)

    def unproject(self, keypoints_xy: ArrayLike) -> Array:
        """Return ``(N, 3)`` rays with unit depth through ``(N, 2)`` undistorted pixels."""
        xy = np.asarray(keypoints_xy, dtype=np.float64)
        return np.stack(
            [(xy[:, 0] - self.cx) / self.fx, (xy[:, 1] - self.cy) / self.fy, np.ones(len(xy))], axis=1
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a mapping that ``from_dict`` reads back."""
        return {**asdict(self), "distortion": list(self.distortion)}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "Intrinsics":
        """Build from a mapping with fx, fy, cx, cy, width and height.

        ``distortion``, ``distortion_model``, ``readout_ms`` and ``readout_from`` may be there. Distortion may
        have another of its usual names, or be given as ``k1``, ``k2``, ``p1`` ... one by one.
        Other keys are notes and ignored, but for those that name a camera which is not known here.

        Raises:
            SourceError: A key is missing, a value is out of range, or the camera is one that is not known,
                such as a panorama.
        """
        try:
            distortion_model, distortion = lens_in(values)
            return Intrinsics(
                fx=_number(values, "fx"),
                fy=_number(values, "fy"),
                cx=_number(values, "cx"),
                cy=_number(values, "cy"),
                width=int(_number(values, "width")),
                height=int(_number(values, "height")),
                distortion=distortion,
                distortion_model=distortion_model,
                readout_ms=_number(values, "readout_ms") if "readout_ms" in values else 0.0,
                readout_from=values.get("readout_from", "top"),
            )
        except KeyError as err:
            raise SourceError(f"intrinsics need fx fy cx cy width height, missing {err}") from err
        except (TypeError, ValueError, OverflowError) as err:
            raise SourceError(f"intrinsics are not valid: {err}") from err

    @staticmethod
    def load(path: Path) -> "Intrinsics":
        """Read ``intrinsics.json``.

        Raises:
            SourceError: The file is missing, not JSON, or not valid intrinsics.
        """
        try:
            values = json.loads(path.read_text(encoding="utf-8-sig"))
        except (OSError, ValueError) as err:
            raise SourceError(f"{path} can't be read as intrinsics: {err}") from err
        if not isinstance(values, dict):
            raise SourceError(f"{path} must hold a JSON object, got {type(values).__name__}")
        try:
            return Intrinsics.from_dict(values)
        except SourceError as err:
            raise SourceError(f"{path}: {err}") from err

    def save(self, path: Path) -> None:
        """Write ``intrinsics.json``, whole or not at all.

        Raises:
            OSError: The file can't be written.
        """
        write_whole(path, json.dumps(self.to_dict(), indent=1) + "\n")


def check_readout(readout_ms: float, readout_from: str) -> None:
    """Check what is said of a rolling shutter.

    Raises:
        ValueError: The time is out of range or the side is none.
    """
    if not 0.0 <= readout_ms <= MAX_READOUT_MS:
        raise ValueError(f"readout_ms must be in [0, {MAX_READOUT_MS:g}], got {readout_ms:g}")
    if readout_from not in get_args(ReadoutFrom):
        raise ValueError(
            f"readout_from must be one of {', '.join(get_args(ReadoutFrom))}, got {readout_from!r}"
        )


def _number(values: dict[str, Any], name: str) -> float:
    """Return a number of a mapping; an error names it."""
    try:
        number = float(values[name])
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {values[name]!r}")
    return number
