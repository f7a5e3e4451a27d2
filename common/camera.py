"""Pinhole intrinsics with lens distortion.

Pixel centres have integer coordinates: the image spans ``[-0.5, width - 0.5]``.
"""

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcast.common.errors import SourceError

Array = NDArray[np.float64]

#: Coefficients of OpenCV's models that are known here: none, radial-tangential, with k3, rational.
_DISTORTION_COUNTS = (0, 4, 5, 8)
_DISTORTION_KEYS = (
    "distortion",
    "distortion_coeffs",
    "distortion_coefficients",
    "dist_coeffs",
    "distCoeffs",
    "dist",
    "D",
)
#: The same one by one, in OpenCV's order.
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: Keys that may name a lens model, and parts of words that none of a pinhole camera has.
_MODEL_KEYS = ("distortion_model", "distortion_type", "camera_model", "model", "type")
_NO_PINHOLE = (
    "fisheye",
    "equidist",
    "kannala",
    "omni",
    "double_sphere",
    "panoram",
    "equirect",
    "spheri",
)
_NO_PINHOLE_WORDS = ("mei", "ds", "eucm", "fov", "kb4", "kb8")
#: Parts of the words for models whose coefficients are known here.
_KNOWN_MODELS = ("none", "rad", "plumb", "rational", "brown", "opencv", "pinhole")


def known_distortion(coefficients: Iterable[Any]) -> tuple[float, ...]:
    """Return coefficients of a file without the trailing zeros of a longer model than was fitted.

    OpenCV writes its rational model as 14 coefficients, of which the last 6 (thin prism, tilt) are zero.
    """
    values = tuple(float(value) for value in coefficients)
    fitting = (n for n in _DISTORTION_COUNTS if n <= len(values) and not any(values[n:]))
    return values[: next(fitting, len(values))]


def _check_pinhole(values: dict[str, Any]) -> None:
    for key, value in values.items():
        word = str(value).lower()
        is_fisheye = word in _NO_PINHOLE_WORDS or any(part in word for part in _NO_PINHOLE)
        if key.lower() in _MODEL_KEYS and is_fisheye and not word.startswith("none"):
            raise ValueError(f"{key} must be a pinhole camera's (pinhole, radtan, none), got {value!r}")
        if key.lower() in ("is_fisheye", "fisheye") and value:
            raise ValueError(f"{key} must be false for a pinhole camera, got {value!r}")


def _distortion_of(values: dict[str, Any]) -> tuple[float, ...]:
    """Return the coefficients; none only where no key speaks of distortion, never for want of reading it."""
    read = {key: known_distortion(numbers) for key, numbers in _distortions_in(values)}
    found = {key: coefficients for key, coefficients in read.items() if coefficients}
    if len(set(found.values())) > 1:
        raise ValueError(f"{' and '.join(found)} must say the same, got {list(found.values())}")
    for key in ("distortion_model", "distortion_type") if found else ():
        word = str(values.get(key) or "none").lower()
        if not any(part in word for part in _KNOWN_MODELS):
            raise ValueError(f"{key} must be radtan, plumb_bob, rational or none, got {values[key]!r}")
    return next(iter(found.values()), ())


def _distortions_in(values: dict[str, Any]) -> Iterator[tuple[str, list[float]]]:
    """Yield each key that gives coefficients, with them."""
    named = {key.lower(): value for key, value in values.items() if key.lower() in _COEFFICIENTS}
    if named:
        numbers = {name: _number(name, value) for name, value in named.items()}
        # A fisheye has k1 to k4 alone; the rational model has k4 to k6.
        if numbers.get("k4") and not {"k5", "k6"} <= numbers.keys():
            raise ValueError(f"k4 must be 0 or come with k5 and k6, got {named['k4']!r} (a fisheye?)")
        yield "k1", [numbers.get(name, 0.0) for name in _COEFFICIENTS]
    for key, value in values.items():
        is_known = key in _DISTORTION_KEYS
        is_spoken_of = is_known or re.search("(?<!un)distor|dist_?coef|^dist$", key.lower())
        if not is_spoken_of or key.lower() in _MODEL_KEYS or not value:
            continue
        if isinstance(value, str) and value.lower().startswith("none"):
            continue
        if is_known and isinstance(value, dict):
            _check_pinhole(value)
            inner = dict(_distortions_in({"D" if k == "data" else k: v for k, v in value.items()}))
            if inner:
                yield key, next(iter(inner.values()))
                continue
        if not is_known or not isinstance(value, list | tuple):
            known = ", ".join(_DISTORTION_KEYS)
            raise ValueError(f"{key} must be a list of numbers named {known}, got {value!r}")
        flat = value[0] if len(value) == 1 and isinstance(value[0], list) else value  # OpenCV's are 1 x N
        yield key, [_number(key, number) for number in flat]


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} must be of numbers, got {value!r}")
    return float(value)


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
        distortion: OpenCV coefficients ``k1 k2 p1 p2 [k3 [k4 k5 k6]]``; empty means none.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: A focal length or a side is not positive, or a value is not finite.
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
        if len(self.distortion) not in _DISTORTION_COUNTS or not np.all(np.isfinite(self.distortion)):
            raise ValueError(f"distortion must be 0, 4, 5 or 8 finite values, got {self.distortion}")

    @property
    def K(self) -> Array:
        """3x3 calibration matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def shape_hw(self) -> tuple[int, int]:
        """Image height and width in pixels."""
        return self.height, self.width

    def scaled_to(self, width: int, height: int) -> "Intrinsics":
        """Return the intrinsics of the same image resized to ``width x height``.

        With integer pixel centres a resize maps ``x`` to ``(x + 0.5) * s - 0.5``; the principal point
        follows that, not ``cx * s``.
        """
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            width=width,
            height=height,
            distortion=self.distortion,
        )

    def undistorted(self) -> "Intrinsics":
        """Return the same pinhole without distortion: the camera of the undistorted image."""
        return Intrinsics(**{**asdict(self), "distortion": ()})

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
        """Build from a mapping with fx, fy, cx, cy, width, height and optionally ``distortion``.

        Distortion may have another of its usual names, or be given as ``k1``, ``k2``, ``p1`` ... one by one.
        Other keys are notes and ignored, but for those that name a lens which is none of a pinhole camera.

        Raises:
            SourceError: A key is missing, a value is out of range, or the camera is a fisheye or panorama.
        """
        try:
            _check_pinhole(values)
            return Intrinsics(
                fx=float(values["fx"]),
                fy=float(values["fy"]),
                cx=float(values["cx"]),
                cy=float(values["cy"]),
                width=int(values["width"]),
                height=int(values["height"]),
                distortion=_distortion_of(values),
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
        """Write ``intrinsics.json``."""
        path.write_text(json.dumps(self.to_dict(), indent=1) + "\n", encoding="utf-8")
