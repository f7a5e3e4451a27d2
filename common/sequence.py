"""A recorded image sequence with random access: images as the codec gets them, times, camera, true path."""

import logging
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import HOW_TO_GIVE, CameraSettings
from semcast.common.errors import SourceError
from semcast.common.geometry import interpolate_pose
from semcast.common.playback import check_playback, usual_period_ns
from semcast.common.sequence_layouts import Layout, SequenceFiles, ns_to_seconds, read_layout
from semcast.common.sequence_sizes import size_in_header_wh
from semcast.common.tiff_alpha import is_laid_on_black
from semcast.common.trajectory import Trajectory

logger = logging.getLogger(__name__)

#: Poses further apart than this many frames are not interpolated between.
_MAX_GAP_FRAMES = 2.0
#: The first image that can be read tells the size; so many unreadable ones may come before it.
_MAX_BAD_AT_START = 9
#: Resampling and sharpening leave pictures of 0..1 or 0..255 with values above, but hardly by this factor.
_OVERSHOOT = 2.0
#: Bits of a 16-bit image that cameras use, always the lower ones.
_BIT_DEPTHS = (8, 10, 12, 14, 16)
#: So many images, spread over a recording, tell its bit depth: a dark beginning alone would mislead.
_MAX_DEPTH_IMAGES = 9


def read_image(path: Path, bit_depth: Callable[[], int | None] | None = None) -> NDArray[np.uint8]:
    """Read an image file as ``(H, W, 3)`` uint8 RGB.

    Grey is repeated, 16-bit is cut to 8, transparency is laid on white. Orientation notes of cameras are
    not applied: a calibration belongs to the pixels as stored.

    Args:
        path: The file.
        bit_depth: Tells how many bits of a 16-bit file are in use; asked for such files alone. None, or
            an answer of None, goes by the brightest value of this one, so that images read one by one may
            differ in brightness.

    Raises:
        SourceError: The file is missing or damaged.
    """
    raw, is_on_black = _read_raw(path)
    if raw.dtype == np.uint16:
        bits = (bit_depth() if bit_depth is not None else None) or _bits_for(int(raw.max()))
        raw = (np.minimum(raw, 2**bits - 1) >> (bits - 8)).astype(np.uint8)
    try:
        return as_rgb(raw, is_on_black=is_on_black)
    except SourceError as err:
        raise SourceError(f"{path}: {err}") from err


def bit_depth_of(paths: tuple[Path, ...]) -> int | None:
    """Tell how many bits of 16-bit images are in use: 8, 10, 12, 14 or 16; None where none is seen.

    Machine vision and thermal cameras store 10 to 14 bits as the lower ones of 16.

    Args:
        paths: Images of one camera; a few are looked at.
    """
    brightest: int | None = None
    spread = np.linspace(0, len(paths) - 1, min(len(paths), _MAX_DEPTH_IMAGES)).astype(int)
    for path in (paths[k] for k in spread):
        try:
            raw, _ = _read_raw(path)
        except SourceError:
            continue
        if raw.dtype == np.uint16:
            brightest = max(brightest or 0, int(raw.max()))
    return None if brightest is None else _bits_for(brightest)


def _bits_for(brightest: int) -> int:
    return next(bits for bits in _BIT_DEPTHS if brightest < 2**bits)


def _read_raw(path: Path) -> tuple[NDArray, bool]:
    """Read what OpenCV makes of a file, and whether its colours are multiplied by alpha."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as err:
        raise SourceError(f"{path} can't be read: {err.strerror or err}") from err
    raw = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if raw is None:
        raise SourceError(f"{path} is not a readable image (damaged, or of an unknown format)")
    is_on_black = raw.ndim == 3 and raw.shape[2] == 4 and is_laid_on_black(data.tobytes(), 8 * raw.itemsize)
    return np.asarray(raw), is_on_black


def as_rgb(raw: NDArray, *, is_on_black: bool = False) -> NDArray[np.uint8]:
    """Turn what OpenCV reads (grey, BGR or BGRA, of any number type) into ``(H, W, 3)`` uint8 RGB.

    Transparency is laid on white.

    Args:
        raw: The image.
        is_on_black: Colours are multiplied by alpha.

    Raises:
        SourceError: The values are neither those of 0..1 nor of 0..255, nor 16-bit.
    """
    raw = _as_bytes(raw)
    if raw.ndim == 2 or raw.shape[2] == 1:
        return np.asarray(cv2.cvtColor(raw, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    if raw.shape[2] == 4:
        alpha = raw[:, :, 3:].astype(np.uint16)
        colours = raw[:, :, 2::-1].astype(np.uint16)
        on_black = colours if is_on_black else (colours * alpha + 127) // 255
        return np.asarray(np.minimum(on_black + (255 - alpha), 255), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _as_bytes(raw: NDArray) -> NDArray[np.uint8]:
    """Bring values to 0..255; where white is, the type tells for 8 and 16 bit, else the values themselves."""
    if raw.dtype == np.uint8:
        return raw
    if raw.dtype == np.uint16:
        return (raw >> 8).astype(np.uint8)
    values = np.asarray(raw, dtype=np.float64)
    brightest = float(values.max(where=np.isfinite(values), initial=0.0))
    if brightest > 255.0 * _OVERSHOOT:
        raise SourceError(f"values must be in 0..1 or 0..255, got up to {brightest:g}")
    scale = 255.0 if raw.dtype.kind == "f" and brightest <= _OVERSHOOT else 1.0
    scaled = np.nan_to_num(values * scale, nan=0.0, posinf=255.0, neginf=0.0)
    return np.rint(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)


class ImageRectifier:
    """Removes distortion and resizes: from a camera's images to those of a pinhole of another size.

    Args:
        camera: Of the images that go in; None when it is unknown and only the size changes.
        size_wh: Size that comes out.

    The border that undistortion uncovers is black. Shrinking averages over areas.
    """

    def __init__(self, camera: Intrinsics | None, size_wh: tuple[int, int]) -> None:
        self._size_wh = size_wh
        self._maps: tuple[NDArray, NDArray] | None = None
        if camera is not None and camera.distortion:
            K = camera.K
            x, y = cv2.initUndistortRectifyMap(
                K, np.array(camera.distortion), None, K, (camera.width, camera.height), cv2.CV_16SC2
            )
            self._maps = (x, y)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image undistorted and resized; the same object when there is nothing to do."""
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
        return resized(image, self._size_wh)


def resized(image: NDArray[np.uint8], size_wh: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize by area averaging (bilinear where it grows); the same object when the size is right."""
    height, width = image.shape[:2]
    if (width, height) == size_wh:
        return image
    shrinks = size_wh[0] <= width and size_wh[1] <= height
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size_wh, interpolation=how), dtype=np.uint8)


def resized_wh(width: int, height: int, factor: float) -> tuple[int, int]:
    """Return the size after a resize by ``factor``, rounded to whole pixels.

    Raises:
        ValueError: The factor is not in [0.05, 1].
    """
    check_playback(resize=factor)
    return max(1, round(width * factor)), max(1, round(height * factor))


class Sequence:
    """A recording, opened by ``open_sequence``. Safe to read from several threads.

    Attributes:
        name: Folder name.
        frame_ids: ``(N,)`` int64, the index of each frame in the whole recording: ``arange(N)`` unless a
            stride was asked for.
        times_ns: ``(N,)`` int64, recorded time of each frame, strictly increasing.
    """

    def __init__(
        self,
        files: SequenceFiles,
        camera: Intrinsics | None,
        size_wh: tuple[int, int],
        resize: float,
        kept: slice,
    ) -> None:
        """Take files and camera as read; see ``open_sequence``."""
        self.name = files.name
        self.frame_ids: NDArray[np.int64] = np.arange(len(files.image_paths), dtype=np.int64)[kept]
        self.times_ns: NDArray[np.int64] = files.times_ns[kept]
        self._all_paths = files.image_paths
        self._paths = files.image_paths[kept]
        self._stored_wh = size_wh
        self._stored_camera = camera
        self._size_wh = resized_wh(*size_wh, resize)
        self._rectify = ImageRectifier(camera, self._size_wh)
        self._truth = _truth_of(files, self.times_ns)

    def __len__(self) -> int:
        return len(self._paths)

    @cached_property
    def _bit_depth(self) -> int | None:
        """Bits of 16-bit images in use, the same for all of them; None where they are too few to tell."""
        bits = bit_depth_of(self._all_paths)
        if bits not in (None, 16):
            logger.info(
                "%s: its 16-bit images are read as %d-bit, by their brightest values", self.name, bits
            )
        return bits

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of the images that ``image`` returns."""
        return self._size_wh

    @property
    def intrinsics(self) -> Intrinsics:
        """Pinhole, without distortion, of the images that ``image`` returns.

        Raises:
            SourceError: The recording says nothing about its camera and none was given.
        """
        return self.stored_camera.undistorted().scaled_to(*self._size_wh)

    @property
    def stored_camera(self) -> Intrinsics:
        """Camera of the images as stored, with the distortion that ``image`` removes.

        Raises:
            SourceError: The recording says nothing about its camera and none was given.
        """
        if self._stored_camera is None:
            raise SourceError(f"the camera of {self.name} is unknown: {HOW_TO_GIVE}")
        return self._stored_camera

    def image(self, index: int, camera: Intrinsics | None = None) -> NDArray[np.uint8]:
        """Return frame ``index`` as ``(H, W, 3)`` uint8 RGB, undistorted and resized.

        Args:
            index: In [0, len): a position in this sequence, not a ``frame_id`` where there is a stride.
            camera: Bring the image to the size of this camera, which must see the same field of view.

        Raises:
            IndexError: There is no such frame.
            SourceError: The file is missing, damaged or of another size than the first readable one.
            ValueError: ``camera`` is not a resized version of this one.
        """
        if not 0 <= index < len(self._paths):
            raise IndexError(f"frame must be in [0, {len(self._paths) - 1}], got {index}")
        raw = read_image(self._paths[index], lambda: self._bit_depth)
        self._check_size(self._paths[index], (raw.shape[1], raw.shape[0]))
        image = self._rectify(raw)
        if camera is None or (camera.width, camera.height) == self._size_wh:
            return image
        if self._stored_camera is not None:
            same = self.intrinsics.scaled_to(camera.width, camera.height)
            if not np.allclose(same.K, camera.K, rtol=0.01, atol=1.0):
                raise ValueError(f"camera must be {self.name}'s own at another size, {same}, got {camera}")
        return resized(image, (camera.width, camera.height))

    def refused_images(self, most_decoded: int = 100) -> tuple[list[str], int]:
        """Tell cheaply which images ``image`` would refuse.

        PNG and JPEG files that look whole are believed what they state; others are decoded.

        Args:
            most_decoded: Decode at most so many.

        Returns:
            One message for each image refused, and how many images were not looked at.
        """
        messages: list[str] = []
        num_decoded = num_skipped = 0
        for path in self._paths:
            size_wh = size_in_header_wh(path)
            if size_wh is None and num_decoded == most_decoded:
                num_skipped += 1
                continue
            try:
                if size_wh is None:
                    num_decoded += 1
                    height, width = read_image(path).shape[:2]
                    size_wh = (width, height)
                self._check_size(path, size_wh)
            except SourceError as err:
                messages.append(str(err))
        return messages, num_skipped

    def _check_size(self, path: Path, size_wh: tuple[int, int]) -> None:
        if size_wh != self._stored_wh:
            raise SourceError(
                f"{path} is {size_wh[0]}x{size_wh[1]}, "
                f"the first readable image of the sequence is {self._stored_wh[0]}x{self._stored_wh[1]}"
            )

    def groundtruth(self) -> Trajectory | None:
        """Return the true camera poses, None where there are none.

        Times are exactly ``times_ns * 1e-9`` of the frames; frames without a true pose nearby are absent.
        """
        return self._truth


def _truth_of(files: SequenceFiles, times_ns: NDArray[np.int64]) -> Trajectory | None:
    """Return the true poses at some of a recording's frames; say so where it has some, but none at those."""
    if files.groundtruth is None:
        return None
    truth = truth_at_frames(files.groundtruth, times_ns, usual_period_ns(files.times_ns) * 1e-9)
    if truth is None and len(files.groundtruth):
        true_s, own_s = files.groundtruth.t_s, ns_to_seconds(times_ns)
        logger.warning(
            "%s: none of its %d true poses, from %.3f to %.3f s, is at the time of an image, "
            "from %.3f to %.3f s: they are not used",
            files.name,
            len(true_s),
            *(true_s[0], true_s[-1], own_s[0], own_s[-1]),
        )
    return truth


def open_truth(path: Path) -> tuple[Trajectory | None, NDArray[np.int64]]:
    """Return a recording's true path, None without one, and the times of its frames by frame id.

    Its images and its camera, which may be unknown, are not looked at.

    Raises:
        SourceError: A part is missing or damaged.
    """
    files = read_layout(path, "auto", 10.0)
    return _truth_of(files, files.times_ns), files.times_ns


def truth_at_frames(truth: Trajectory, times_ns: NDArray[np.int64], period_s: float) -> Trajectory | None:
    """Bring true poses to the times of frames.

    A pose within a thousandth of a frame is taken as it is. Between two poses that are at most two frames
    apart, of which the nearer one is within half a frame, position is interpolated linearly and rotation
    along the geodesic. All other frames get none.

    Args:
        truth: Poses at their own times.
        times_ns: ``(N,)`` frame times, strictly increasing.
        period_s: Usual time between two frames of the recording.

    Returns:
        Poses at the times of those frames that have one; None when no frame has.
    """
    times_s = ns_to_seconds(times_ns)
    if len(truth) == 0:
        return None
    right = np.clip(np.searchsorted(truth.t_s, times_s), 1, max(1, len(truth) - 1))
    left = np.clip(right - 1, 0, len(truth) - 1)
    right = np.minimum(right, len(truth) - 1)
    kept: list[int] = []
    poses: list[NDArray[np.float64]] = []
    for k, t in enumerate(times_s):
        a, b = int(left[k]), int(right[k])
        nearest = a if abs(truth.t_s[a] - t) <= abs(truth.t_s[b] - t) else b
        distance_s = abs(float(truth.t_s[nearest]) - t)
        gap_s = float(truth.t_s[b] - truth.t_s[a])
        # Epoch times of 1e9 s have a float resolution of 2e-7 s.
        if distance_s <= max(1e-3 * period_s, 1e-6):
            poses.append(truth.T_world_cam[nearest])
        elif (
            truth.t_s[a] < t < truth.t_s[b]
            and gap_s <= _MAX_GAP_FRAMES * period_s
            and distance_s <= 0.5 * period_s
        ):
            share = (t - float(truth.t_s[a])) / gap_s
            poses.append(interpolate_pose(truth.T_world_cam[a], truth.T_world_cam[b], share))
        else:
            continue
        kept.append(k)
    return Trajectory(times_s[kept], np.array(poses)) if kept else None


def retimed(truth: Trajectory, times_ns: NDArray[np.int64], t_source_ns: Mapping[int, int]) -> Trajectory:
    """Bring a true path to the times of a stream: an agent may have said how fast a folder was taken.

    Args:
        truth: Of a sequence, at the times of its frames.
        times_ns: ``(N,)`` times of the sequence's frames, by frame id.
        t_source_ns: Frame id to time in the stream, of frames that came; ids beyond N are of a later pass.

    Returns:
        The path as it is where the times are the same; else its part between the frames that came.
    """
    ids = np.array(sorted(k for k in t_source_ns if k < len(times_ns)), dtype=np.int64)
    own_s = ns_to_seconds(times_ns[ids])
    stream_s = ns_to_seconds(np.array([t_source_ns[k] for k in ids.tolist()], dtype=np.int64))
    if len(ids) < 2 or np.array_equal(own_s, stream_s) or not (np.diff(stream_s) > 0).all():
        return truth
    between = (truth.t_s >= own_s[0]) & (truth.t_s <= own_s[-1])
    return Trajectory(np.interp(truth.t_s[between], own_s, stream_s), truth.T_world_cam[between])


def open_sequence(
    path: Path,
    intrinsics: Intrinsics | CameraSettings | None = None,
    layout: Layout = "auto",
    resize: float = 1.0,
    stride: int = 1,
    max_frames: int | None = None,
    rate_hz: float = 10.0,
) -> Sequence:
    """Open a recorded sequence.

    Args:
        path: Folder in the native, TUM, KITTI odometry, EuRoC or NeRF layout, a folder of images, or a
            ``transforms*.json`` file.
        intrinsics: Camera to use instead of what the recording says, for the images as stored.
        layout: Layout to read; ``auto`` looks.
        resize: Factor on the image size, intrinsics follow.
        stride: Use every n-th frame.
        max_frames: Use at most so many.
        rate_hz: Frame rate of layouts that record no times.

    Raises:
        SourceError: Something is missing, damaged or contradicts itself; the message says what.
        ValueError: An argument is out of range.
    """
    check_playback(stride=stride, max_frames=max_frames)
    if not rate_hz > 0:
        raise ValueError(f"rate_hz must be positive, got {rate_hz:g}")
    files = read_layout(Path(path), layout, rate_hz)
    width, height = _first_size_wh(files.image_paths)
    camera = intrinsics.resolve(width, height) if isinstance(intrinsics, CameraSettings) else intrinsics
    if camera is None:
        camera = files.camera(width, height)
    if camera is not None and (camera.width, camera.height) != (width, height):
        raise SourceError(
            f"intrinsics of {files.name} are for {camera.width}x{camera.height} images, "
            f"its images are {width}x{height}"
        )
    if camera is not None:
        camera.check_possible(files.name)
    stop = None if max_frames is None else max_frames * stride
    return Sequence(files, camera, (width, height), resize, slice(None, stop, stride))


def _first_size_wh(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Return the size of the first image that can be read: one damaged file does not spoil the rest."""
    first_error: SourceError | None = None
    for path in paths[: _MAX_BAD_AT_START + 1]:
        try:
            height, width = read_image(path).shape[:2]
        except SourceError as err:
            first_error = first_error or err
        else:
            return width, height
    assert first_error is not None, "a layout has at least one image"
    raise first_error
