"""Lens distortion as calibration files of many tools name it, under OpenCV's coefficients; checks of cameras.

A lens is read whole or refused: points of an image whose distortion was left out would be quietly wrong.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

#: Coefficients of OpenCV's models that are known here: none, radial-tangential, with k3, rational.
DISTORTION_COUNTS = (0, 4, 5, 8)

_DISTORTION_KEYS = (
    "distortion",
    "distortion_coeffs",
    "distortion_coefficients",
    "Distortion_Coefficients",
    "dist_coeffs",
    "distCoeffs",
    "dist",
    "D",
    "d",
    "coeffs",
)
#: The same one by one, in OpenCV's order.
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: Keys that may name a lens model, and parts of words that none of a pinhole camera has.
_MODEL_KEYS = ("distortion_model", "distortion_type", "camera_model", "model", "type")
_FISHEYE_KEYS = ("is_fisheye", "fisheye", "fisheye_model")
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
#: By how much of itself an intrinsic may differ between images: programs that fit a camera to each one differ
#: by less where it is the same, and a zoom moves the focal length by more.
_SAME_CAMERA = 0.01
#: Part of the words for models that map the other way, as RealSense's ``inverse_brown_conrady`` does.
_INVERSE = "inverse"
#: Parts of the words for models whose coefficients are known here.
_KNOWN_MODELS = ("none", "rad", "plumb", "rational", "brown", "opencv", "pinhole")


def known_distortion(coefficients: Iterable[Any]) -> tuple[float, ...]:
    """Return coefficients of a file without the trailing zeros of a longer model than was fitted.

    OpenCV writes its rational model as 14 coefficients, of which the last 6 (thin prism, tilt) are zero.
    """
    values = tuple(float(value) for value in coefficients)
    fitting = (n for n in DISTORTION_COUNTS if n <= len(values) and not any(values[n:]))
    return values[: next(fitting, len(values))]


def check_pinhole(values: dict[str, Any]) -> None:
    """Check that no key of a calibration names a lens that is none of a pinhole camera.

    Raises:
        ValueError: One does.
    """
    for key, value in values.items():
        word = str(value).lower()
        is_fisheye = word in _NO_PINHOLE_WORDS or any(part in word for part in _NO_PINHOLE)
        if key.lower() in _MODEL_KEYS and is_fisheye and not word.startswith("none"):
            raise ValueError(f"{key} must be a pinhole camera's (pinhole, radtan, none), got {value!r}")
        if key.lower() in _FISHEYE_KEYS and value:
            raise ValueError(f"{key} must be false for a pinhole camera, got {value!r}")


def check_one_camera(name: str, values: Sequence[float]) -> None:
    """Check that images were taken by one camera that does not zoom.

    Args:
        name: Of an intrinsic, such as ``fx``.
        values: What it is for each image, at least one.

    Raises:
        ValueError: They differ by more than a hundredth of the largest.
    """
    low, high = min(values), max(values)
    if not high - low <= _SAME_CAMERA * abs(high):
        raise ValueError(
            f"{name} must be the same for all images (one camera, no zoom), got {low:g} to {high:g}"
        )


def distortion_in(values: dict[str, Any]) -> tuple[float, ...]:
    """Return the coefficients that a calibration gives, under any usual key or as ``k1``, ``k2``, ``p1`` ...

    None only where no key speaks of distortion, never for want of reading it.

    Raises:
        ValueError: A key that speaks of distortion can't be read, or two say different things.
    """
    read = {key: known_distortion(numbers) for key, numbers in _distortions_in(values)}
    found = {key: coefficients for key, coefficients in read.items() if coefficients}
    if len(set(found.values())) > 1:
        raise ValueError(f"{' and '.join(found)} must say the same, got {list(found.values())}")
    for key, value in values.items() if any(map(any, found.values())) else ():
        if key.lower() in _MODEL_KEYS and _INVERSE in str(value).lower():
            raise ValueError(f"{key} must map points to where the lens shows them, got {value!r}")
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
        is_spoken_of = is_known or re.search("(?<!un)distor|dist_?coef", key.lower())
        if not is_spoken_of or key.lower() in _MODEL_KEYS or _says_none(value):
            continue
        yield key, _coefficients(key, value, is_known=is_known)


def _says_none(value: Any) -> bool:
    # An empty text heads lines that could not be read; an empty list is a lens without distortion.
    return value.lower().startswith("none") if isinstance(value, str) else not value


def _coefficients(key: str, value: Any, *, is_known: bool) -> list[float]:
    if is_known and isinstance(value, dict):
        check_pinhole(value)
        inner = dict(_distortions_in({"D" if k == "data" else k: v for k, v in value.items()}))
        if inner:
            return next(iter(inner.values()))
    if not is_known or not isinstance(value, list | tuple):
        known = ", ".join(_DISTORTION_KEYS)
        raise ValueError(f"{key} must be a list of numbers named {known}, got {value!r}")
    flat = value[0] if len(value) == 1 and isinstance(value[0], list) else value  # OpenCV's are 1 x N
    return [_number(key, number) for number in flat]


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} must be of numbers, got {value!r}")
    return float(value)
