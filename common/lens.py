"""Lens distortion as calibration files of many tools name it, under OpenCV's coefficients; checks of cameras.

A lens is read whole or refused: points of an image whose distortion was left out would be quietly wrong.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal, get_args

#: How a lens bends rays: radially and tangentially (Brown-Conrady, with k4 to k6 rational), or as a fisheye
#: whose pixels lie by the angle to the axis (Kannala-Brandt, which ROS and Kalibr call equidistant).
DistortionModel = Literal["radtan", "equidistant"]

#: Coefficients of the models: none, radial-tangential, with k3, rational; the fisheye's k1 to k4.
_COUNTS: dict[str, tuple[int, ...]] = {"radtan": (0, 4, 5, 8), "equidistant": (4,)}

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
#: The same of a fisheye; others it must not have.
_OF_FISHEYE = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
#: Keys that may name a lens model or a fisheye.
_MODEL_KEYS = ("distortion_model", "distortion_type", "camera_model", "model", "type")
_FISHEYE_KEYS = ("is_fisheye", "fisheye", "fisheye_model")
_YES, _NO = ("true", "yes", "on", "1", "1.0"), ("false", "no", "off", "0", "0.0", "none", "")
#: Words for the equidistant fisheye, without what stands between their parts. COLMAP's radial ones have fewer
#: of its coefficients; ORB-SLAM's KannalaBrandt8 counts those of the pinhole too.
_EQUIDISTANT = (
    "equidistant",
    "equi",
    "pinholeequi",
    "fisheye",
    "opencvfisheye",
    "radialfisheye",
    "simpleradialfisheye",
    "kannalabrandt",
    "kannalabrandt4",
    "kannalabrandt8",
    "kb4",
)
#: Parts of words, and whole ones, for cameras that are not read.
_UNKNOWN_CAMERA = (
    "fisheye",
    "equidist",
    "kannala",
    "omni",
    "double_sphere",
    "panoram",
    "equirect",
    "spheri",
)
_UNKNOWN_CAMERA_WORDS = ("mei", "ds", "eucm", "fov", "kb8")
#: By how much of itself an intrinsic may differ between images: programs that fit a camera to each one differ
#: by less where it is the same, and a zoom moves the focal length by more.
_SAME_CAMERA = 0.01
#: Part of the words for models that map the other way, as RealSense's ``inverse_brown_conrady`` does.
_INVERSE = "inverse"
#: Parts of the words for models whose coefficients are known here.
_RADTAN = ("rad", "plumb", "rational", "brown")
_KNOWN_MODELS = ("none", *_RADTAN, "opencv", "pinhole")


def check_distortion(model: str, coefficients: Sequence[float]) -> None:
    """Check that a lens is one that is known here.

    Raises:
        ValueError: There is no such model, or it has another number of coefficients.
    """
    if model not in get_args(DistortionModel):
        raise ValueError(
            f"distortion_model must be one of {', '.join(get_args(DistortionModel))}, got {model!r}"
        )
    if len(coefficients) not in _COUNTS[model] or not all(map(math.isfinite, coefficients)):
        *counts, last = map(str, _COUNTS[model])
        what = f"{', '.join(counts)} or {last}" if counts else last
        whose = " (k1 to k4 of a fisheye)" if model == "equidistant" else ""
        raise ValueError(f"distortion must be {what} finite values{whose}, got {tuple(coefficients)}")


def lens_in(values: dict[str, Any]) -> tuple[DistortionModel, tuple[float, ...]]:
    """Return model and coefficients that a calibration gives, see ``Intrinsics``.

    Coefficients may be under any usual key or be given as ``k1``, ``k2``, ``p1`` ... one by one. There are
    none only where no key speaks of distortion, never for want of reading it; a fisheye then has zeros.

    Raises:
        ValueError: A key that speaks of the lens can't be read, or two say different things.
    """
    model = _model_in(values)
    found = {
        key: coefficients
        for key, numbers in _distortions_in(values, model)
        if (coefficients := _known_distortion(numbers, model))
    }
    if len(set(found.values())) > 1:
        raise ValueError(f"{' and '.join(found)} must say the same, got {list(found.values())}")
    for key, value in values.items() if any(map(any, found.values())) else ():
        if key.lower() in _MODEL_KEYS and _INVERSE in str(value).lower():
            raise ValueError(f"{key} must map points to where the lens shows them, got {value!r}")
    for key in ("distortion_model", "distortion_type") if found and model == "radtan" else ():
        word = str(values.get(key) or "none").lower()
        if not any(part in word for part in _KNOWN_MODELS):
            raise ValueError(
                f"{key} must be radtan, plumb_bob, rational, equidistant or none, got {values[key]!r}"
            )
    return model, next(iter(found.values()), (0.0,) * min(_COUNTS[model]))


def _known_distortion(numbers: Sequence[float], model: DistortionModel) -> tuple[float, ...]:
    """Return coefficients of a file without the trailing zeros of a longer model than was fitted.

    OpenCV writes its rational model as 14 coefficients, of which the last 6 (thin prism, tilt) are zero.
    """
    values = tuple(float(value) for value in numbers)
    fitting = (n for n in _COUNTS[model] if n <= len(values) and not any(values[n:]))
    return values[: next(fitting, len(values))]


def _model_in(values: dict[str, Any]) -> DistortionModel:
    """Return the model that the keys of a calibration name, radial-tangential where none does.

    Raises:
        ValueError: One names a camera that is not known here, or two say different things.
    """
    inner = [value for key, value in values.items() if key in _DISTORTION_KEYS and isinstance(value, dict)]
    said: dict[str, DistortionModel] = {}
    for key, value in (item for part in (values, *inner) for item in part.items()):
        word = str(value).lower()
        if key.lower() in _FISHEYE_KEYS and _is_true(key, value):
            said[key] = "equidistant"
        if key.lower() not in _MODEL_KEYS or word.startswith("none"):
            continue
        if re.sub(r"[\W_]", "", word.removeprefix("distortion.")) in _EQUIDISTANT:
            said[key] = "equidistant"
        elif word in _UNKNOWN_CAMERA_WORDS or any(part in word for part in _UNKNOWN_CAMERA):
            raise ValueError(
                f"{key} must be a pinhole camera's (pinhole, radtan, none) or equidistant, got {value!r}"
            )
        elif key.lower().startswith("distortion") and any(part in word for part in _RADTAN):
            said[key] = "radtan"
    if len(set(said.values())) > 1:
        raise ValueError(f"{' and '.join(said)} must say the same, got {', '.join(said.values())}")
    return next(iter(said.values()), "radtan")


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


def _distortions_in(values: dict[str, Any], model: DistortionModel) -> Iterator[tuple[str, list[float]]]:
    """Yield each key that gives coefficients, with them."""
    named = {key.lower(): value for key, value in values.items() if key.lower() in _COEFFICIENTS}
    if named:
        numbers = {name: _number(name, value) for name, value in named.items()}
        # A fisheye has k1 to k4 alone; the rational model has k4 to k6.
        if model == "radtan" and numbers.get("k4") and not {"k5", "k6"} <= numbers.keys():
            raise ValueError(
                f"k4 must be 0 or come with k5 and k6, got {named['k4']!r} (a fisheye? Then give "
                "distortion_model equidistant)"
            )
        names = _COEFFICIENTS if model == "radtan" else _OF_FISHEYE
        yield "k1", [numbers.get(name, 0.0) for name in names]
    for key, value in values.items():
        is_known = key in _DISTORTION_KEYS
        is_spoken_of = is_known or re.search("(?<!un)distor|dist_?coef", key.lower())
        if not is_spoken_of or key.lower() in _MODEL_KEYS or _says_none(value):
            continue
        yield key, _coefficients(key, value, model, is_known=is_known)


def _is_true(key: str, value: Any) -> bool:
    """Whether a key says yes; YAML's words come as text.

    Raises:
        ValueError: It says neither yes nor no.
    """
    word = str(value).lower()
    if word not in (*_YES, *_NO):
        raise ValueError(f"{key} must be true or false, got {value!r}")
    return word in _YES


def _says_none(value: Any) -> bool:
    # An empty text heads lines that could not be read; an empty list is a lens without distortion.
    return value.lower().startswith("none") if isinstance(value, str) else not value


def _coefficients(key: str, value: Any, model: DistortionModel, *, is_known: bool) -> list[float]:
    if is_known and isinstance(value, dict):
        inner = dict(_distortions_in({"D" if k == "data" else k: v for k, v in value.items()}, model))
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
