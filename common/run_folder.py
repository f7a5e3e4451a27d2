"""The folder a run leaves behind (``--out``) and the reconstruction in it that other tools are fed from.

===================== =================================================================================
``trajectory.tum``    poses of all frames, ``t tx ty tz qx qy qz qw``, camera to world
``map.ply``           landmarks with colour and confidence
``dense.ply``         the dense cloud, likewise
``summary.json``      figures of the run
``settings.toml``     resolved settings of the server or the replay
``demo.toml``         resolved settings of a demo, its link among them
``frames.jsonl``      one row per frame: state, part, SNR, PSNR, inliers, stage times
``run.rrd``           what the viewer showed
``reconstruction.npz`` what ``semcast export`` needs, see ``RunData``
``images/``           decoded images, ``<frame id, six digits>.jpg``, of keyframes or of all frames
===================== =================================================================================

The server fills ``RunData`` from ``Reconstruction``: intrinsics of decoded (undistorted) images, frame ids,
times and ``final_trajectory()`` of all posed frames, keyframe ids, ``landmarks()``, ``observations()`` as
(landmark id, keyframe id, x, y), and the parts of the map that frames and landmarks are in.
"""

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.npz_file import read_npz, write_npz
from semcast.common.shapes import check_shape

TRAJECTORY_NAME = "trajectory.tum"
MAP_NAME = "map.ply"
DENSE_NAME = "dense.ply"
SUMMARY_NAME = "summary.json"
SETTINGS_NAME = "settings.toml"
DEMO_SETTINGS_NAME = "demo.toml"
FRAMES_NAME = "frames.jsonl"
VIEWER_NAME = "run.rrd"
RECONSTRUCTION_NAME = "reconstruction.npz"
IMAGES_NAME = "images"
CHECKPOINT_NAME = "checkpoint.npz"

#: What is written at the end of a run, and when it is asked for.
RESULT_FILES = (TRAJECTORY_NAME, MAP_NAME, DENSE_NAME, RECONSTRUCTION_NAME, SUMMARY_NAME, SETTINGS_NAME)
#: What is written on the way.
RECORD_FILES = (FRAMES_NAME, VIEWER_NAME, CHECKPOINT_NAME)
#: All files a run may leave, besides those in the folder ``IMAGES_NAME``.
RUN_FILES = (*RESULT_FILES, DEMO_SETTINGS_NAME, *RECORD_FILES)

#: What images and ``run.rrd`` leave free of a disk: the path, the map and the dense cloud, up to some 50 MB,
#: come last.
RESERVED_BYTES = 100_000_000

FORMAT = 1
MAX_UNPACKED_BYTES = 4 * 1024**3


@dataclass(frozen=True, kw_only=True)
class PartInMetres:
    """What a unit of a part of the map is, and where the part is in the frame of a marker.

    Attributes:
        part: Its number.
        marker_id: Number of the marker.
        num_keyframes: That show it alike.
        m_per_unit: Metres in a unit of the map.
        relative_sigma: Standard deviation of that as a share of it.
        T_marker_world: 4x4 with its translation in metres: a point of the map, times ``m_per_unit``, to the
            marker's frame.
    """

    part: int
    marker_id: int
    num_keyframes: int
    m_per_unit: float
    relative_sigma: float
    T_marker_world: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check what an export would be made from.

        Raises:
            ValueError: A number is not finite, the unit is not above 0 m, or the transform has no rotation.
        """
        T = np.asarray(self.T_marker_world, dtype=np.float64)
        check_shape(T, "4 4", "T_marker_world")
        object.__setattr__(self, "T_marker_world", T)
        is_finite = np.isfinite(T).all() and 0.0 <= self.relative_sigma < np.inf
        if not (is_finite and 0.0 < self.m_per_unit < np.inf):
            raise ValueError(f"metres of part {self.part} must be finite, and a unit above 0 m")
        R = T[:3, :3]
        if not (np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0):
            raise ValueError(f"T_marker_world of part {self.part} must hold a rotation, got {R.tolist()}")

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {**asdict(self), "T_marker_world": self.T_marker_world.tolist()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Take back what ``to_dict`` returned."""
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class RunData:
    """A finished reconstruction.

    Attributes:
        intrinsics: Camera of the decoded images, without distortion.
        frame_ids: ``(F,)`` int64, strictly increasing, all posed frames.
        t_source_ns: ``(F,)`` int64, recorded time of each.
        T_world_cam: ``(F, 4, 4)`` float64.
        frame_submap: ``(F,)`` int64, part of the map each is in at the end; poses of two parts don't fit
            together, as place and scale of a later part are guessed.
        keyframe_ids: ``(K,)`` int64, a subset of ``frame_ids``.
        landmark_ids: ``(N,)`` int64, unique.
        xyz: ``(N, 3)`` float64 in the world frame, map units.
        rgb: ``(N, 3)`` uint8.
        confidence: ``(N,)`` float32 in [0, 1].
        landmark_submap: ``(N,)`` int64, part of the map each is in at the end.
        observed_landmark_ids: ``(M,)`` int64, each in ``landmark_ids``.
        observed_keyframe_ids: ``(M,)`` int64, each in ``keyframe_ids``.
        observed_xy: ``(M, 2)`` float32, pixels, integer values at pixel centres.
        metres: Of each part whose unit the run itself found.
    """

    intrinsics: Intrinsics
    frame_ids: NDArray[np.int64]
    t_source_ns: NDArray[np.int64]
    T_world_cam: NDArray[np.float64]
    frame_submap: NDArray[np.int64]
    keyframe_ids: NDArray[np.int64]
    landmark_ids: NDArray[np.int64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    landmark_submap: NDArray[np.int64]
    observed_landmark_ids: NDArray[np.int64]
    observed_keyframe_ids: NDArray[np.int64]
    observed_xy: NDArray[np.float32]
    metres: tuple[PartInMetres, ...] = ()

    def __post_init__(self) -> None:
        """Convert to the dtypes above, check shapes and references.

        Raises:
            ValueError: Shapes disagree, ids repeat or refer to nothing, or a pose is not finite.
        """
        for name, (dtype, pattern) in _ARRAYS.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            check_shape(array, pattern, name)
            object.__setattr__(self, name, array)
        for first, *others in (
            ("frame_ids", "t_source_ns", "T_world_cam", "frame_submap"),
            ("landmark_ids", "xyz", "rgb", "confidence", "landmark_submap"),
            ("observed_landmark_ids", "observed_keyframe_ids", "observed_xy"),
        ):
            for other in others:
                if len(getattr(self, other)) != len(getattr(self, first)):
                    raise ValueError(
                        f"{other} must have {len(getattr(self, first))} rows as {first} has, "
                        f"got {len(getattr(self, other))}"
                    )
        if np.any(np.diff(self.frame_ids) <= 0):
            raise ValueError("frame_ids must strictly increase")
        if len(np.unique(self.landmark_ids)) != len(self.landmark_ids):
            raise ValueError("landmark_ids must be unique")
        if not np.all(np.isfinite(self.T_world_cam)):
            raise ValueError("T_world_cam must be finite")
        for name, owner in (
            ("keyframe_ids", "frame_ids"),
            ("observed_keyframe_ids", "keyframe_ids"),
            ("observed_landmark_ids", "landmark_ids"),
        ):
            unknown = np.setdiff1d(getattr(self, name), getattr(self, owner))
            if len(unknown):
                raise ValueError(f"{name} must be in {owner}, got {unknown[:3].tolist()}")


#: Array of ``RunData`` -> its dtype in the file and its shape.
_ARRAYS: dict[str, tuple[Any, str]] = {
    "frame_ids": (np.int64, "F"),
    "t_source_ns": (np.int64, "F"),
    "T_world_cam": (np.float64, "F 4 4"),
    "frame_submap": (np.int64, "F"),
    "keyframe_ids": (np.int64, "K"),
    "landmark_ids": (np.int64, "N"),
    "xyz": (np.float64, "N 3"),
    "rgb": (np.uint8, "N 3"),
    "confidence": (np.float32, "N"),
    "landmark_submap": (np.int64, "N"),
    "observed_landmark_ids": (np.int64, "M"),
    "observed_keyframe_ids": (np.int64, "M"),
    "observed_xy": (np.float32, "M 2"),
}
assert {*_ARRAYS, "intrinsics", "metres"} == {f.name for f in fields(RunData)}
#: Arrays that older runs lack -> those they go with; such a run counts as one part.
_ADDED = {"frame_submap": "frame_ids", "landmark_submap": "landmark_ids"}


def write_run(folder: Path, data: RunData) -> None:
    """Write ``reconstruction.npz`` into a run folder, whole or not at all.

    Raises:
        SourceError: The folder can't be made or the file can't be written.
    """
    path = folder / RECONSTRUCTION_NAME
    header = {
        "format": FORMAT,
        "intrinsics": data.intrinsics.to_dict(),
        "metres": [part.to_dict() for part in data.metres],
    }
    try:
        write_npz(path, header, {name: getattr(data, name) for name in _ARRAYS}, compressed=True)
    except OSError as err:
        raise SourceError(f"{path} can't be written: {err}") from err


def read_run(folder: Path) -> RunData:
    """Read ``reconstruction.npz`` of a run folder; never executes what is in the file.

    Raises:
        SourceError: There is no such run, or the file is damaged or of another version.
    """
    path = folder / RECONSTRUCTION_NAME
    if not folder.is_dir():
        raise SourceError(f"{folder} is not a folder; give the folder that --out wrote")
    if not path.is_file():
        raise SourceError(
            f"{folder} holds no {RECONSTRUCTION_NAME}; a run writes it when it ends, and only with a map"
        )
    try:
        header, content = read_npz(path, MAX_UNPACKED_BYTES)
    except OSError as err:
        raise SourceError(f"{path} can't be read: {err}") from err
    except ValueError as err:
        raise SourceError(f"{path} {err}") from err
    if header.get("format") != FORMAT:
        raise SourceError(f"{path} has format {header.get('format')}, this semcast reads {FORMAT}")
    try:
        arrays = {name: content[name] for name in _ARRAYS if name in content or name not in _ADDED}
        for name, owner in _ADDED.items():
            arrays.setdefault(name, np.zeros(len(arrays[owner]), dtype=np.int64))
        metres = tuple(PartInMetres.from_dict(part) for part in header.get("metres", ()))
        return RunData(intrinsics=Intrinsics.from_dict(header["intrinsics"]), metres=metres, **arrays)
    except Exception as err:  # what is in place of an array or a number fails in many ways
        raise SourceError(f"{path} is damaged: {err}") from err


def files_of_run(folder: Path) -> list[Path]:
    """Return the files that a run left in its folder, those of results first, without images."""
    return [folder / name for name in RUN_FILES if (folder / name).is_file()]


def shortage(folder: Path) -> str | None:
    """Say how little of a folder's disk is free where no more than results need is; None where more is."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError:  # who writes will say it
        return None
    if free >= RESERVED_BYTES:
        return None
    return (
        f"{free / 1e6:.0f} MB of the disk are free, of which {RESERVED_BYTES / 1e6:.0f} are kept for results"
    )


def image_name(frame_id: int) -> str:
    """Return the file name of a frame's decoded image."""
    return f"{frame_id:06d}.jpg"


def read_image_paths(folder: Path) -> dict[int, Path]:
    """Return frame id to path of the decoded images a run kept; empty where it kept none."""
    images = folder / IMAGES_NAME
    if not images.is_dir():
        return {}
    return {int(p.stem): p for p in sorted(images.glob("*.jpg")) if p.stem.isdecimal()}
