"""Intrinsics from a file: ``intrinsics.json``, or YAML as OpenCV, ROS, EuRoC, Kalibr and ORB-SLAM write it.

Only the part of YAML that calibration files use is read: nested keys and numbers, alone, in ``[...]`` lists
or in lists of one ``- number`` a line. A YAML library would not spare us this: what OpenCV writes
(``%YAML:1.0``, ``!!opencv-matrix``) is not YAML to them. Principal points keep the file's value: these tools
count pixels from their centres, as we do.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.lens import lens_in

_LINE = re.compile(r"^(?P<indent> *)(?P<key>[A-Za-z_][\w.\- ]*?) *:(?: +|$)(?P<value>.*)$")
_ITEM = re.compile(r"^(?P<indent> *)(?:- +)+(?P<value>.*)$")
_SIZE_KEYS = (("image_width", "image_height"), ("Camera.width", "Camera.height"), ("width", "height"))
_MATRIX_KEYS = ("camera_matrix", "K", "k", "Camera_Matrix", "cameraMatrix")


def read_intrinsics(path: Path) -> Intrinsics:
    """Read intrinsics from ``.json`` or from ``.yaml`` / ``.yml``.

    Raises:
        SourceError: The file can't be read, misses a value, or the camera is not known here.
    """
    if path.suffix.lower() == ".json":
        return Intrinsics.load(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise SourceError(f"intrinsics must be a .json, .yaml or .yml file, got {path}")
    # Kalibr puts each camera of a rig under its own heading.
    values = {key.removeprefix("cam0/"): value for key, value in read_flat_yaml(path).items()}
    try:
        return _intrinsics_from_yaml(values)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as err:
        what = f"{err} is missing" if isinstance(err, KeyError) else str(err)
        raise SourceError(f"{path} holds no usable intrinsics: {what}") from err


def read_flat_yaml(path: Path) -> dict[str, Any]:
    """Read nested ``key: value`` lines into one mapping with keys joined by ``/``.

    Values are floats, lists of floats (lists of lists are strung together), or the bare text: "" for a key
    that only heads others. Anything else that calibration files don't hold is kept as text.

    Raises:
        SourceError: The file can't be read.
    """
    try:
        # Some editors put a byte order mark first, which would become part of the first key.
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as err:
        raise SourceError(f"{path} can't be read: {err}") from err
    values: dict[str, Any] = {}
    parents: list[tuple[int, str]] = []
    for line in _whole_lines(text):
        item, match = _ITEM.match(line), _LINE.match(line)
        if item is not None:
            # Items may stand right under their key, without being set in further.
            while parents and parents[-1][0] > len(item["indent"]):
                parents.pop()
            key = "/".join(name for _, name in parents)
            values[key] = _with_item(values.get(key), item["value"])
        elif match is not None:
            indent = len(match["indent"])
            while parents and parents[-1][0] >= indent:
                parents.pop()
            value = re.sub(r"^!!\S+\s*", "", match["value"].strip())
            values["/".join([*(name for _, name in parents), match["key"]])] = _value(value)
            if not value:
                parents.append((indent, match["key"]))
    return values


def _whole_lines(text: str) -> Iterator[str]:
    """Yield lines without comments; a ``[...]`` list that goes over several lines comes as one."""
    whole = ""
    for line in text.splitlines():
        line = re.sub(r"(^|\s)#.*$", "", line).rstrip()
        whole = f"{whole} {line.strip()}" if whole else line
        if whole.count("[") <= whole.count("]"):
            yield whole
            whole = ""
    if whole:
        yield whole


def _with_item(value: Any, text: str) -> Any:
    """Return a list with one more item, itself a number or a list; text where an item is neither."""
    item = _value(text)
    before = [] if value in (None, "") else value
    if not isinstance(before, list) or isinstance(item, str):
        return f"- {text}"
    return [*before, *(item if isinstance(item, list) else [item])]


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
    if numbers in (None, ""):
        return None
    matrix = np.asarray(numbers, dtype=np.float64)
    if matrix.shape != (16,) or not np.isfinite(matrix).all():
        raise ValueError(f"{key} must have 16 finite numbers, got {numbers}")
    return matrix.reshape(4, 4)


def _intrinsics_from_yaml(values: dict[str, Any]) -> Intrinsics:
    prefix = next((p for p in ("Camera.", "Camera1.") if f"{p}fx" in values), "")  # ORB-SLAM's
    lens = _lens_keys(values, prefix or "Camera.")
    distortion_model, distortion = lens_in(lens)
    if prefix:
        fx, fy, cx, cy = (float(values[prefix + name]) for name in ("fx", "fy", "cx", "cy"))
    elif "intrinsics" in values:
        fx, fy, cx, cy = _numbers(values, ("intrinsics",), 4)
    else:
        fx, _, cx, _, fy, cy, *_ = _numbers(values, _MATRIX_KEYS, 9)
    width, height = _size(values)
    return Intrinsics(
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=width,
        height=height,
        distortion=distortion,
        distortion_model=distortion_model,
    )


def _lens_keys(values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return the keys of the top level as a lens has them: with what stands under them, without a prefix."""
    lens: dict[str, Any] = {}
    for key, value in values.items():
        head, _, inner = key.partition("/")
        if not inner:
            lens[key.removeprefix(prefix).removeprefix("Camera.")] = value  # type and size have no number
        elif head in lens:
            under = lens[head] if isinstance(lens[head], dict) else {}
            lens[head] = {**under, inner: value}
    return lens


def _list(values: dict[str, Any], keys: tuple[str, ...]) -> list[float] | None:
    places = (place for key in keys for place in (f"{key}/data", key))
    return next((values[place] for place in places if isinstance(values.get(place), list)), None)


def _numbers(values: dict[str, Any], keys: tuple[str, ...], count: int) -> list[float]:
    found = _list(values, keys)
    there = next((key for key in keys if key in values), None)
    if there is None:
        raise KeyError(" or ".join(keys[:2]))
    if found is None or len(found) != count:
        got = found or values.get(f"{there}/data", values[there])
        raise ValueError(f"{there} must be a list of {count} numbers, got {got!r}")
    return found


def _size(values: dict[str, Any]) -> tuple[int, int]:
    if isinstance(values.get("resolution"), list):
        width, height = values["resolution"]
        return int(width), int(height)
    for width_key, height_key in _SIZE_KEYS:
        if width_key in values and height_key in values:
            return int(values[width_key]), int(values[height_key])
    raise KeyError("image_width")
