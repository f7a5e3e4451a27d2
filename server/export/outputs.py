"""What a run leaves behind: its files, each on its own, as PLY map, timed trajectory, JSON without NaN."""

import dataclasses
import json
import math
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcast import __version__
from semcast.common.errors import SemcastError, SourceError
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory
from semcast.common.whole_file import write_whole

PACKAGES = ("numpy", "torch", "opencv-python-headless", "eclipse-zenoh", "rerun-sdk", "gtsam", "poselib")

PLY_VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("confidence", "<f4"),
    ]
)
#: The same for points so far from the origin that single precision would put them on steps.
PLY_FAR_VERTEX = np.dtype(
    [(name, "<f8" if name in "xyz" else PLY_VERTEX[name]) for name in PLY_VERTEX.names or ()]
)
#: Share of a cloud's extent that these steps may be.
_MAX_STEP_SHARE = 1e-5
_PLY_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar"}
_PLY_START = ("ply", "format binary_little_endian 1.0")
_PLY_END = b"end_header\n"
#: Axes and unit of a map.
MAP_FRAME = "x right, y down, z forward of the first camera; map units"


def _ply_properties(vertex: np.dtype) -> list[str]:
    return [f"property {_PLY_TYPES[vertex[name].str]} {name}" for name in vertex.names or ()]


class EachFile:
    """Writes files each on its own: what can't be written costs no other, and is named when the block ends.

    Raises:
        OSError: At the end of the block, some files could not be written.
    """

    def __init__(self) -> None:
        self._failures: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None and self._failures:
            raise OSError("; ".join(self._failures))

    @contextmanager
    def attempt(self, path: Path) -> Iterator[Path]:
        """Take note of a file that can't be written in the block, or whose content can't be made."""
        try:
            yield path
        except (OSError, SemcastError, ValueError) as err:
            at_fault = err if isinstance(err, OSError) else err.__cause__
            self._failures.append(f"{path.name}: {getattr(at_fault, 'strerror', None) or err}")


def write_ply(
    path: Path,
    xyz: ArrayLike,
    rgb: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    *,
    frame: str = MAP_FRAME,
) -> None:
    """Write landmarks as binary PLY with colour and a ``confidence`` property in [0, 1], whole or not at all.

    Points with a non-finite coordinate are left out. Coordinates are in single precision, and in double where
    all points are far from the origin, as in a frame of satellites.

    Args:
        path: File to write.
        xyz: ``(N, 3)`` in the world frame, map units.
        rgb: ``(N, 3)``.
        confidence: ``(N,)``.
        frame: What axes and unit are, for the comment in the file.
    """
    points = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
    finite = np.isfinite(points).all(axis=1)
    vertex = PLY_FAR_VERTEX if _is_far(points[finite]) else PLY_VERTEX
    vertices = np.empty(int(finite.sum()), dtype=vertex)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = points[finite, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = rgb[finite, channel]
    vertices["confidence"] = confidence[finite]
    header = [
        *_PLY_START,
        f"comment semcast map; {frame}",
        f"element vertex {len(vertices)}",
        *_ply_properties(vertex),
    ]
    write_whole(path, "\n".join(header).encode("ascii") + b"\n" + _PLY_END + vertices.tobytes())


def _is_far(points: NDArray[np.float64]) -> bool:
    """Tell whether single precision is too coarse for what points ``(N, 3)`` differ by."""
    if len(points) == 0:
        return False
    step = float(np.spacing(np.abs(points).max().astype(np.float32)))
    return bool(0.0 < _MAX_STEP_SHARE * np.ptp(points, axis=0).max() < step)


def read_ply(path: Path) -> NDArray[np.void]:
    """Read what ``write_ply`` wrote; returns ``(N,)`` of ``PLY_VERTEX`` or ``PLY_FAR_VERTEX``.

    Raises:
        SourceError: The file can't be read, or isn't one of ours.
    """
    try:
        header, end, body = path.read_bytes().partition(_PLY_END)
    except OSError as err:
        raise SourceError(f"{path} can't be read: {err.strerror}") from err
    lines = header.decode("ascii", errors="replace").splitlines()
    properties = [line for line in lines if line.startswith("property ")]
    vertex = next((v for v in (PLY_VERTEX, PLY_FAR_VERTEX) if _ply_properties(v) == properties), None)
    if not end or tuple(lines[:2]) != _PLY_START or vertex is None:
        raise SourceError(f"{path} is not a cloud that semcast wrote")
    if len(body) % vertex.itemsize or f"element vertex {len(body) // vertex.itemsize}" not in lines:
        raise SourceError(f"{path} is damaged: {len(body)} bytes do not hold the points that it promises")
    return np.frombuffer(body, dtype=vertex)


def trajectory_of(poses: Mapping[int, NDArray[np.float64]], t_source_ns: Mapping[int, int]) -> Trajectory:
    """Order poses by frame id and give them the source's times; equal or falling times are left out.

    Args:
        poses: Frame id to ``T_world_cam``.
        t_source_ns: Frame id to recorded time.
    """
    times_ns: list[int] = []
    kept: list[NDArray[np.float64]] = []
    for frame_id in sorted(poses):
        if frame_id not in t_source_ns:
            continue
        t_ns = t_source_ns[frame_id]
        # As floats of seconds two times may be one.
        if times_ns and t_ns * 1e-9 <= times_ns[-1] * 1e-9:
            continue
        times_ns.append(t_ns)
        kept.append(poses[frame_id])
    exactly = np.array(times_ns, dtype=np.int64)
    return Trajectory(ns_to_seconds(exactly), np.array(kept, dtype=np.float64).reshape(-1, 4, 4), exactly)


def plain(value: Any, path_text: Callable[[Path], str] = str) -> Any:
    """Return a value as JSON knows it: numpy becomes Python, settings mappings, NaN and infinity None.

    Args:
        value: Of plain values, arrays, paths, settings, and mappings and sequences of them.
        path_text: What stands for a path.

    Raises:
        TypeError: A value has no JSON form.
    """
    if value is None or (isinstance(value, (str, bool, int)) and not isinstance(value, Enum)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return path_text(value)
    if isinstance(value, Enum):
        return plain(value.value, path_text)
    if isinstance(value, np.generic):
        return plain(value.item(), path_text)
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), path_text)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name), path_text) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v, path_text) for k, v in value.items()}
    if isinstance(value, Sequence):
        return [plain(v, path_text) for v in value]
    raise TypeError(f"JSON can't hold {type(value).__name__}")


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write JSON without NaN, whole or not at all."""
    write_whole(path, json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


def versions_of(packages: Iterable[str]) -> dict[str, str]:
    """Return the versions of semcast, of Python and of those of some packages that are installed."""
    found = {"semcast": __version__, "python": platform.python_version()}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def versions() -> dict[str, str]:
    """Return what the figures of a run depend on: versions, and the kind of machine."""
    return {**versions_of(PACKAGES), "machine": platform.machine()}
