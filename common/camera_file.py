"""Intrinsics from a file: ``intrinsics.json``, or YAML as OpenCV, ROS, EuRoC and ORB-SLAM write it.

Only the part of YAML that calibration files use is read: nested keys and numbers, alone or in ``[...]``
lists. Principal points keep the file's value: these tools count pixels from their centres, as we do.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError

_LINE = re.compile(r"^(?P<indent> *)(?P<key>[A-Za-z_][\w.\- ]*?) *:(?: +|$)(?P<value>.*)$")
_PINHOLE_DISTORTION = ("radtan", "radial-tangential", "plumb_bob", "rational_polynomial", "none", "")
_SIZE_KEYS = (("image_width", "image_height"), ("Camera.width", "Camera.height"), ("width", "height"))


def read_intrinsics(path: Path) -> Intrinsics:
    """Read intrinsics from ``.json`` or from ``.yaml`` / ``.yml``.

    Raises:
        SourceError: The file can't be read, misses a value or is not a pinhole camera.
    """
    if path.suffix.lower() == ".json":
        return Intrinsics.load(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise SourceError(f"intrinsics must be a .json, .yaml or .yml file, got {path}")
    values = read_flat_yaml(path)
    try:
        return _intrinsics_from_yaml(values)
    except (KeyError, TypeError, ValueError, IndexError) as err:
        what = f"{err} is missing" if isinstance(err, KeyError) else str(err)
        raise SourceError(f"{path} holds no usable intrinsics: {what}") from err


def read_flat_yaml(path: Path) -> dict[str, Any]:
    """Read nested ``key: value`` lines into one mapping with keys joined by ``/``.

    Values are floats, lists of floats, or the bare text. Lists of other lists and anything else that
    calibration files don't hold is kept as text.

    Raises:
        SourceError: The file can't be read.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise SourceError(f"{path} can't be read: {err}") from err
    values: dict[str, Any] = {}
    parents: list[tuple[int, str]] = []
    pending: str | None = None
    text = ""
    for line in lines:
        line = re.sub(r"(^|\s)#.*$", "", line).rstrip()
        if pending is not None:
            text += " " + line.strip()
        else:
            match = _LINE.match(line)
            if match is None:
                continue
            indent = len(match["indent"])
            while parents and parents[-1][0] >= indent:
                parents.pop()
            pending = "/".join([*(name for _, name in parents), match["key"]])
            text = re.sub(r"^!!\S+\s*", "", match["value"].strip())
            if not text:
                parents.append((indent, match["key"]))
                pending = None
                continue
        if text.count("[") > text.count("]"):
            continue
        values[pending] = _value(text)
        pending = None
    return values


def _value(text: str) -> Any:
    stripped = text.strip().strip("\"'")
    try:
        if stripped.startswith("[") and stripped.endswith("]"):
            return [
                float(item)
                for item in stripped[1:-1].replace("[", "").replace("]", "").split(",")
                if item.strip()
            ]
        return float(stripped)
    except ValueError:
        return stripped


def transform_from_yaml(values: dict[str, Any], key: str) -> NDArray[np.float64] | None:
    """Return the 4x4 matrix under ``key`` or ``key/data``, None where there is none.

    Raises:
        ValueError: It has not 16 numbers.
    """
    numbers = values.get(f"{key}/data", values.get(key))
    if numbers is None:
        return None
    matrix = np.asarray(numbers, dtype=np.float64)
    if matrix.shape != (16,) or not np.isfinite(matrix).all():
        raise ValueError(f"{key} must have 16 finite numbers, got {numbers}")
    return matrix.reshape(4, 4)


def _intrinsics_from_yaml(values: dict[str, Any]) -> Intrinsics:
    model = str(values.get("distortion_model", "")).lower()
    if model not in _PINHOLE_DISTORTION:
        raise ValueError(f"distortion_model must be radial-tangential, got {model!r}")
    width, height = _size(values)
    if "Camera.fx" in values or "Camera1.fx" in values:
        prefix = "Camera." if "Camera.fx" in values else "Camera1."
        fx, fy, cx, cy = (float(values[prefix + name]) for name in ("fx", "fy", "cx", "cy"))
        names = [n for n in ("k1", "k2", "p1", "p2", "k3") if prefix + n in values]
        distortion = [float(values[prefix + n]) for n in names]
    elif isinstance(values.get("intrinsics"), list):
        fx, fy, cx, cy = values["intrinsics"]
        distortion = values.get("distortion_coefficients", [])
    else:
        K = _first(values, "camera_matrix/data", "K/data", "Camera_Matrix/data", "cameraMatrix/data")
        fx, cx, fy, cy = K[0], K[2], K[4], K[5]
        distortion = _first(
            values,
            "distortion_coefficients/data",
            "Distortion_Coefficients/data",
            "dist_coeffs/data",
            "distCoeffs/data",
            "D/data",
            default=[],
        )
    if not any(distortion):
        distortion = []
    return Intrinsics(
        fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, distortion=tuple(float(d) for d in distortion)
    )


def _first(values: dict[str, Any], *keys: str, default: Any = None) -> Any:
    for key in keys:
        if isinstance(values.get(key), list):
            return values[key]
    if default is None:
        raise KeyError(keys[0].split("/")[0])
    return default


def _size(values: dict[str, Any]) -> tuple[int, int]:
    if isinstance(values.get("resolution"), list):
        width, height = values["resolution"]
        return int(width), int(height)
    for width_key, height_key in _SIZE_KEYS:
        if width_key in values and height_key in values:
            return int(values[width_key]), int(values[height_key])
    raise KeyError("image_width")
