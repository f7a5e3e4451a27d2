"""``transforms.json`` of NeRF-synthetic and nerfstudio: a pinhole and poses with OpenGL axes.

OpenGL's are x right, y up, z backward.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import T_opencv_opengl, project_to_so3
from semcast.common.image_order import order_of
from semcast.common.lens import check_one_camera, lens_in

#: Models that undistortion turns into a pinhole; nerfstudio's others are panoramas and the like.
_MODELS = ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
#: What frames may say each for themselves.
_CAMERA_OF_FRAME = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x")


@dataclass(frozen=True)
class TransformsFile:
    """What a ``transforms.json`` holds.

    Attributes:
        image_paths: One per frame, in the order of their names; a name without suffix is a ``.png``.
        T_world_cam: ``(N, 4, 4)``, camera axes x right, y down, z forward.
        camera: Returns the intrinsics of images of a given width and height, None where the file has none.
    """

    image_paths: tuple[Path, ...]
    T_world_cam: NDArray[np.float64]
    camera: Callable[[int, int], Intrinsics | None]


def read_transforms_json(path: Path, suffixes: tuple[str, ...]) -> TransformsFile:
    """Read the file.

    Args:
        path: The file.
        suffixes: Of images, lower case.

    Raises:
        SourceError: It can't be read, a matrix is none, or the frames are of several cameras.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        found = list(document["frames"])
        frames = [found[k] for k in order_of([str(frame["file_path"]) for frame in found])]
        images = tuple(_image(path.parent, str(frame["file_path"]), suffixes) for frame in frames)
        T_world_gl = _matrices(frames)
        _check_frames(document, frames)
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as err:
        what = f"{err} is missing" if isinstance(err, KeyError) else str(err)
        raise SourceError(f"{path} can't be used as transforms.json: {what}") from err

    def camera(width: int, height: int) -> Intrinsics | None:
        try:
            return _camera({**frames[0], **document}, width, height)
        except (ValueError, TypeError, OverflowError) as err:
            raise SourceError(f"{path} holds no usable intrinsics: {err}") from err

    return TransformsFile(images, T_world_gl @ T_opencv_opengl, camera)


def _image(folder: Path, name: str, suffixes: tuple[str, ...]) -> Path:
    place = folder / name
    return place if place.suffix.lower() in suffixes else place.with_name(place.name + ".png")


def _matrices(frames: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Return the frames' ``(N, 4, 4)`` camera-to-world matrices; a last row 0 0 0 1 may be missing.

    Raises:
        ValueError: One has another shape or a number that is not finite.
    """
    if not frames:
        return np.zeros((0, 4, 4))
    matrices = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64)
    if matrices.shape[1:] not in ((4, 4), (3, 4)):
        raise ValueError(f"transform_matrix must be 4x4 or 3x4, got {'x'.join(map(str, matrices.shape[1:]))}")
    if not np.isfinite(matrices).all():
        raise ValueError("transform_matrix must be finite")
    T_world_gl = np.tile(np.eye(4), (len(frames), 1, 1))
    T_world_gl[:, :3] = matrices.reshape(len(frames), -1, 4)[:, :3]
    for T in T_world_gl:
        T[:3, :3] = project_to_so3(T[:3, :3])
    return T_world_gl


def _check_frames(document: dict[str, Any], frames: list[dict[str, Any]]) -> None:
    """Check that frames which bring intrinsics of their own were taken by one camera that does not zoom.

    Raises:
        ValueError: See ``check_one_camera``.
        KeyError: Only some frames have it.
    """
    for key in _CAMERA_OF_FRAME:
        if key in document or not any(key in frame for frame in frames):
            continue
        check_one_camera(key, [float(frame[key]) for frame in frames])


def _camera(values: dict[str, Any], width: int, height: int) -> Intrinsics | None:
    """Read the camera; these files count pixels from their corners, so principal points move by half.

    Raises:
        ValueError: It is of another kind, or a value is out of range.
    """
    model = values.get("camera_model")
    if model and str(model).upper() not in _MODELS:
        raise ValueError(f"camera_model must be one of {', '.join(_MODELS)}, got {model!r}")
    distortion_model, distortion = lens_in(values)
    width, height = int(values.get("w", width)), int(values.get("h", height))
    if "fl_x" in values:
        fx = float(values["fl_x"])
    elif distortion_model == "equidistant":
        raise ValueError("a fisheye must come with fl_x")  # camera_angle_x is meant for a pinhole
    elif "camera_angle_x" in values:
        angle_rad = float(values["camera_angle_x"])
        if not 0.0 < angle_rad < np.pi:
            raise ValueError(f"camera_angle_x must be in (0, pi) radians, got {angle_rad:g}")
        fx = 0.5 * width / float(np.tan(0.5 * angle_rad))
    else:
        return None
    return Intrinsics(
        fx=fx,
        fy=float(values.get("fl_y", fx)),
        cx=float(values.get("cx", width / 2)) - 0.5,
        cy=float(values.get("cy", height / 2)) - 0.5,
        width=width,
        height=height,
        distortion=distortion,
        distortion_model=distortion_model,
    )
