"""How a user says what the camera is: a calibration file, or the four numbers of a pinhole."""

from dataclasses import dataclass, field
from pathlib import Path

from semcast.common.camera import Intrinsics
from semcast.common.camera_file import read_intrinsics
from semcast.common.errors import SourceError

HOW_TO_GIVE = (
    "put intrinsics.json (fx fy cx cy width height) beside the images, or give --intrinsics FILE "
    "(.json, or .yaml of OpenCV, ROS or EuRoC), or --fx --fy --cx --cy in pixels"
)


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Intrinsics from the command line; all unset means: take what the source itself says.

    Raises:
        ValueError: Only some of fx, fy, cx, cy are given, or a file and numbers.
    """

    intrinsics: Path | None = field(
        default=None, metadata={"help": "calibration: intrinsics.json, or YAML of OpenCV, ROS or EuRoC"}
    )
    fx: float | None = field(default=None, metadata={"help": "focal length in pixels, horizontal"})
    fy: float | None = field(default=None, metadata={"help": "focal length in pixels, vertical"})
    cx: float | None = field(default=None, metadata={"help": "principal point x in pixels"})
    cy: float | None = field(default=None, metadata={"help": "principal point y in pixels"})
    distortion: tuple[float, ...] = field(
        default=(), metadata={"help": "OpenCV coefficients k1 k2 p1 p2 [k3 [k4 k5 k6]]"}
    )

    def __post_init__(self) -> None:
        given = [name for name in ("fx", "fy", "cx", "cy") if getattr(self, name) is not None]
        if given and len(given) < 4:
            raise ValueError(f"fx, fy, cx and cy must be given together, got only {', '.join(given)}")
        if given and self.intrinsics is not None:
            raise ValueError(f"give either intrinsics or {', '.join(given)}, got both")
        if self.distortion and not given:
            raise ValueError("distortion must come with fx, fy, cx and cy")

    def resolve(self, width: int, height: int) -> Intrinsics | None:
        """Return the intrinsics for images of this size, None when nothing was given.

        Raises:
            SourceError: The file can't be used, or a number is out of range.
        """
        if self.intrinsics is not None:
            return read_intrinsics(self.intrinsics)
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
            )
        except ValueError as err:
            raise SourceError(f"intrinsics are not valid: {err}") from err
