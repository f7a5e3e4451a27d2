"""A model of COLMAP's: cameras and the poses of images, from its binary or its text files.

COLMAP stores ``T_cam_world`` with the quaternion ``qw qx qy qz``, and its pixel centres are at half integers
(https://colmap.github.io/format.html). Its points are not read.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import invert_transform, make_transform, rotation_from_quat_wxyz
from semcast.common.lens import check_one_camera

T = TypeVar("T")

_PLACES = ("sparse/0", "sparse", "colmap/sparse/0")
#: Models by COLMAP's numbers, with the number of their parameters; some only to name what is refused.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_FISHEYES = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_TWO_FOCAL_LENGTHS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True)
class _Camera:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    name: str
    camera_id: int
    T_cam_world: NDArray[np.float64]


@dataclass(frozen=True)
class ColmapModel:
    """What a model says about images.

    Attributes:
        names: Of the images that have a pose, relative to the folder of images, in the order of the file.
        T_world_cam: ``(N, 4, 4)`` their poses.
        camera: The one that took them, distortion included.
    """

    names: tuple[str, ...]
    T_world_cam: NDArray[np.float64]
    camera: Intrinsics

    def camera_of(self, width: int, height: int) -> Intrinsics:
        """Return the camera of images of a size: data sets hold small copies beside a model of large ones."""
        camera = self.camera
        return camera.scaled_to(width, height) if camera.has_shape_of(width, height) else camera


def colmap_folder(path: Path) -> Path | None:
    """Return the folder of the model that belongs to a folder of images, None where there is none."""
    return next(
        (path / p for p in _PLACES if _file_of(path / p, "cameras") and _file_of(path / p, "images")), None
    )


def half_a_model(path: Path) -> str | None:
    """Say what is missing of the model beside a folder of images; None where it is whole or not there."""
    if colmap_folder(path) is not None:
        return None
    for place in _PLACES:
        for there, missing in (("cameras", "images"), ("images", "cameras")):
            if file := _file_of(path / place, there):
                return f"{file} is half a model of COLMAP's, without {missing}.bin or {missing}.txt"
    return None


def _file_of(folder: Path, name: str) -> Path | None:
    """Return the file of that name, the binary one where there are both, as COLMAP does."""
    return next((f for f in (folder / f"{name}.bin", folder / f"{name}.txt") if f.is_file()), None)


def read_colmap(folder: Path) -> ColmapModel:
    """Read the model in a folder.

    Raises:
        SourceError: A file is missing or damaged, or the images are of several cameras or of an unknown one.
    """
    cameras = dict(_read(folder, "cameras", _cameras_in_bin, _cameras_in_text))
    images = _read(folder, "images", _images_in_bin, _images_in_text)
    if not images:
        raise SourceError(f"{folder} has no image with a pose")
    try:
        used = [_intrinsics(cameras[k]) for k in sorted({image.camera_id for image in images})]
        for name in ("width", "height", "fx", "fy"):
            check_one_camera(name, [float(getattr(camera, name)) for camera in used])
    except KeyError as err:
        raise SourceError(f"{folder} has no camera {err}, which took one of its images") from err
    except (ValueError, OverflowError) as err:
        raise SourceError(f"{folder} holds no usable intrinsics: {err}") from err
    T_cam_world = np.stack([image.T_cam_world for image in images])
    return ColmapModel(tuple(image.name for image in images), invert_transform(T_cam_world), used[0])


def _read(
    folder: Path, name: str, from_bin: Callable[[bytes], Iterator[T]], from_text: Callable[[str], Iterator[T]]
) -> list[T]:
    path = _file_of(folder, name)
    if path is None:
        raise SourceError(f"{folder} must have {name}.bin or {name}.txt to be a model of COLMAP's")
    try:
        if path.suffix == ".bin":
            return list(from_bin(path.read_bytes()))
        return list(from_text(path.read_text(encoding="utf-8-sig")))
    except struct.error as err:
        raise SourceError(f"{path} can't be used as COLMAP's: it ends too early") from err
    except (OSError, ValueError) as err:
        raise SourceError(f"{path} can't be used as COLMAP's: {err}") from err


def _cameras_in_bin(data: bytes) -> Iterator[tuple[int, _Camera]]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, model_number, width, height = struct.unpack_from("<iiQQ", data, at)
        if model_number not in _MODELS:
            raise ValueError(f"camera {number} is of model {model_number}, known are 0 to {max(_MODELS)}")
        model, num_parameters = _MODELS[model_number]
        parameters = struct.unpack_from(f"<{num_parameters}d", data, at + 24)
        at += 24 + 8 * num_parameters
        yield number, _Camera(model, width, height, parameters)


def _cameras_in_text(text: str) -> Iterator[tuple[int, _Camera]]:
    for line in text.splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            number, model, width, height, *parameters = line.split()
            yield int(number), _Camera(model, int(width), int(height), tuple(map(float, parameters)))


def _images_in_bin(data: bytes) -> Iterator[_Image]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise ValueError("it ends within the name of an image")
        name = data[at + 64 : end].decode()
        (num_points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * num_points  # x, y and the number of the point in space
        if at > len(data):
            raise ValueError(f"it ends within the points of {name}")
        yield _image(name, camera_id, pose)


def _images_in_text(text: str) -> Iterator[_Image]:
    lines = iter(text.splitlines())
    for line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = line.split(maxsplit=9)
        if len(values) < 10:
            raise ValueError(f"an image must have a number, a pose of 7, a camera and a name, got {line!r}")
        _, *pose, camera_id, name = values
        name = name.strip()
        # Where the lines of images without points were left out, every second image would be lost.
        if len(next(lines, "").split()) % 3:
            raise ValueError(f"after the line of {name} must come that of its points, 3 values each, or none")
        yield _image(name, int(camera_id), list(map(float, pose)))


def _image(name: str, camera_id: int, pose: list[float]) -> _Image:
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose of {name} must be finite, got {pose}")
    return _Image(name, camera_id, make_transform(rotation_from_quat_wxyz(pose[:4]), pose[4:]))


def _intrinsics(camera: _Camera) -> Intrinsics:
    """Return the pinhole and its distortion in OpenCV's order.

    Raises:
        ValueError: It is of a kind that is not known here, or a parameter is missing or out of range.
    """
    known = dict(_MODELS.values())
    if camera.model not in (*_ONE_FOCAL_LENGTH, *_TWO_FOCAL_LENGTHS):
        names = ", ".join((*_ONE_FOCAL_LENGTH, *_TWO_FOCAL_LENGTHS))
        raise ValueError(f"the camera model must be one of {names}, got {camera.model}")
    if len(camera.parameters) != known[camera.model]:
        raise ValueError(
            f"{camera.model} must have {known[camera.model]} parameters, got {len(camera.parameters)}"
        )
    one = camera.model in _ONE_FOCAL_LENGTH
    fx, fy, cx, cy, *lens = (camera.parameters[0], *camera.parameters) if one else camera.parameters
    # Radial models stop after k1 or k2, where OpenCV's go on with p1 and p2, or k3 and k4.
    is_fisheye = camera.model in _FISHEYES
    distortion = (*lens, *[0.0] * (4 - len(lens))) if is_fisheye or any(lens) else ()
    return Intrinsics(
        fx=fx,
        fy=fy,
        cx=cx - 0.5,
        cy=cy - 0.5,
        width=camera.width,
        height=camera.height,
        distortion=distortion,
        distortion_model="equidistant" if is_fisheye else "radtan",
    )
