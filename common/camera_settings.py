"""How a user says what the camera is: a calibration file, or the four numbers of a pinhole."""

import math
from dataclasses import dataclass, field, fields
from pathlib import Path

from semcast.common.camera import Intrinsics
from semcast.common.camera_file import read_intrinsics
from semcast.common.errors import SourceError
from semcast.common.lens import DistortionModel

HOW_TO_GIVE = (
    "put intrinsics.json (fx fy cx cy width height) into its folder, or give --intrinsics FILE "
    "(.json, or .yaml of OpenCV, ROS or EuRoC), or --fx --fy --cx --cy in pixels. 'semcast calibrate' finds "
    "them from pictures of a chessboard; --focal-35mm 26 (a phone's main camera) is a rough start without, "
    "and 'semcast lens' makes it better from images alone"
)
#: What a pinhole's numbers become as flags.
_FLAGS = ("fx", "fy", "cx", "cy")
#: What settings are that were not given.
_UNSET = (None, (), "radtan")
#: Diagonal of a 35 mm film frame, 36 x 24 mm.
_FILM_DIAGONAL_MM = 43.27


def check_size(camera: Intrinsics, width: int, height: int, name: str) -> None:
    """Check that intrinsics are for images of this size.

    Args:
        camera: Intrinsics of the images as stored.
        width: Of the images.
        height: Of the images.
        name: Of what the images are from, for the message.

    Raises:
        SourceError: They are for another one; the message says what to do.
    """
    if (camera.width, camera.height) == (width, height):
        return
    if camera.has_shape_of(width, height):
        same = camera.scaled_to(width, height)
        numbers = " ".join(f"--{flag} {getattr(same, flag):.6g}" for flag in _FLAGS)
        if camera.distortion:
            numbers += " --distortion " + " ".join(f"{k:.6g}" for k in camera.distortion)
        if camera.distortion_model != "radtan":
            numbers += f" --distortion-model {camera.distortion_model}"
        way = f"if they are the same images at another size, give {numbers}"
    elif camera.has_shape_of(height, width):
        way = "are they turned by 90 degrees? Calibrate with images as they are stored"
    else:
        way = (
            "they must be of the size that was calibrated, neither cut nor stretched: 'semcast calibrate' or "
            "'semcast lens' with these, or --focal-35mm"
        )
    raise SourceError(
        f"intrinsics of {name} are for {camera.width}x{camera.height} images, "
        f"its images are {width}x{height}: {way}"
    )


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Intrinsics from the command line; all unset means: take what the source itself says.

    Raises:
        ValueError: Only some of fx, fy, cx, cy are given, or more than one of file, numbers and
            ``focal_35mm``.
    """

    intrinsics: Path | None = field(
        default=None,
        metadata={"help": "calibration: intrinsics.json, or YAML of OpenCV, ROS, Kalibr or EuRoC"},
    )
    fx: float | None = field(default=None, metadata={"help": "focal length in pixels, horizontal"})
    fy: float | None = field(default=None, metadata={"help": "focal length in pixels, vertical"})
    cx: float | None = field(default=None, metadata={"help": "principal point x in pixels"})
    cy: float | None = field(default=None, metadata={"help": "principal point y in pixels"})
    focal_35mm: float | None = field(
        default=None,
        metadata={
            "help": "focal length in mm of a 35 mm camera with the same view, as phones and EXIF name it: a "
            "rough start where there is no calibration"
        },
    )
    distortion: tuple[float, ...] = field(
        default=(),
        metadata={"help": "OpenCV coefficients k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 of a fisheye"},
    )
    distortion_model: DistortionModel = field(
        default="radtan", metadata={"help": "what the coefficients are of; equidistant is a fisheye"}
    )

    def __post_init__(self) -> None:
        given = [name for name in _FLAGS if getattr(self, name) is not None]
        if given and len(given) < 4:
            raise ValueError(f"fx, fy, cx and cy must be given together, got only {', '.join(given)}")
        if given and self.intrinsics is not None:
            raise ValueError(f"give either intrinsics or {', '.join(given)}, got both")
        if self.focal_35mm is not None and (given or self.intrinsics is not None):
            raise ValueError("focal_35mm must be given alone: a calibration says more")
        if self.focal_35mm is not None and not 5.0 <= self.focal_35mm <= 1000.0:
            raise ValueError(f"focal_35mm must be in [5, 1000], got {self.focal_35mm:g}")
        for name in ("distortion", "distortion_model"):
            if getattr(self, name) not in _UNSET and not given:
                raise ValueError(f"{name} must come with fx, fy, cx and cy")

    def check_has(self, reference: Path | None) -> None:
        """Check that there is a reference these are the camera of, where a receiver was given any of them.

        Raises:
            ValueError: There is none: they would do nothing.
        """
        given = [entry.name for entry in fields(self) if getattr(self, entry.name) not in _UNSET]
        if given and reference is None:
            raise ValueError(
                f"{given[0]} is of the camera of the reference, and there is none (--reference); the camera "
                "of a stream comes from its agent"
            )

    def resolve(self, width: int, height: int) -> Intrinsics | None:
        """Return the intrinsics for images of this size, None when nothing was given.

        Raises:
            SourceError: The file can't be used, or a number is out of range.
        """
        if self.intrinsics is not None:
            return read_intrinsics(self.intrinsics)
        if self.focal_35mm is not None:
            focal_px = self.focal_35mm * math.hypot(width, height) / _FILM_DIAGONAL_MM
            return Intrinsics(
                fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height
            )
        if self.fx is None or self.fy is None or self.cx is None or self.cy is None:
            return None
        try:
            return Intrinsics(
                fx=self.fx,
                fy=self.fy,
                cx=self.cx,
                cy=self.cy,
                width=width,
                height=height,
                distortion=self.distortion,
                distortion_model=self.distortion_model,
            )
        except ValueError as err:
            raise SourceError(f"intrinsics are not valid: {err}") from err
