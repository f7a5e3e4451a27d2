"""A recorded image sequence with random access: images as the codec gets them, times, camera, true path."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import HOW_TO_GIVE, CameraSettings, check_size
from semcast.common.errors import SourceError
from semcast.common.geometry import interpolate_pose
from semcast.common.image import resized, scaled_wh
from semcast.common.image_file import bit_depth_of, read_image
from semcast.common.layouts.files import SequenceFiles
from semcast.common.layouts.layout import Layout, read_layout
from semcast.common.playback import check_playback, usual_period_ns
from semcast.common.sequence_sizes import size_in_header_wh, states_16_bits
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory, read_tum

logger = logging.getLogger(__name__)

#: Poses further apart than this many frames are not interpolated between.
_MAX_GAP_FRAMES = 2.0
#: Median turn between consecutive images of a stream, at most: a view hardly overlaps with one that is turned
#: by half its width, and few hands turn a camera by 200 degrees a second at 10 images a second.
_MOST_TURN_DEG = 20.0
#: The first image that can be read tells the size; so many unreadable ones may come before it.
_MAX_BAD_AT_START = 9


def resized_wh(width: int, height: int, factor: float) -> tuple[int, int]:
    """Return the size after a resize by ``factor``, rounded to whole pixels.

    Raises:
        ValueError: The factor is not in [0.05, 1].
    """
    check_playback(resize=factor)
    return scaled_wh(width, height, factor)


class ImageRectifier:
    """Removes distortion and resizes: from a camera's images to those of a pinhole of another size.

    Args:
        camera: Of the images that go in; None when it is unknown and only the size changes.
        size_wh: Size that comes out.

    The border that undistortion uncovers is black; what a fisheye sees outside the pinhole's image is left
    out. Shrinking averages over areas.
    """

    def __init__(self, camera: Intrinsics | None, size_wh: tuple[int, int]) -> None:
        self._size_wh = size_wh
        self._maps: tuple[NDArray, NDArray] | None = None
        if camera is not None and camera.is_distorted:
            K, size_wh = camera.K, (camera.width, camera.height)
            of_lens = cv2.fisheye if camera.distortion_model == "equidistant" else cv2
            x, y = of_lens.initUndistortRectifyMap(
                K, np.array(camera.distortion), np.eye(3), K, size_wh, cv2.CV_16SC2
            )
            self._maps = (x, y)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image undistorted and resized; the same object when there is nothing to do."""
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
        return resized(image, self._size_wh)


class Sequence:
    """A recording, opened by ``open_sequence``. Safe to read from several threads.

    Attributes:
        name: Folder name.
        frame_ids: ``(N,)`` int64, the index of each frame in the whole recording: ``arange(N)`` unless a
            stride was asked for.
        times_ns: ``(N,)`` int64, recorded time of each frame, strictly increasing.
        size_wh: Width and height of the images that ``image`` returns.
    """

    def __init__(
        self,
        files: SequenceFiles,
        camera: Intrinsics | None,
        first: "_FirstImage",
        resize: float,
        kept: slice,
    ) -> None:
        """Take files and camera as read; see ``open_sequence``."""
        self.name = files.name
        self.frame_ids: NDArray[np.int64] = np.arange(len(files.image_paths), dtype=np.int64)[kept]
        self.times_ns: NDArray[np.int64] = files.times_ns[kept]
        self._all_paths = files.image_paths
        self._paths = files.image_paths[kept]
        self._stored_wh = first.size_wh
        self._is_16_bit = first.is_16_bit
        self._stored_camera = camera
        self.size_wh = resized_wh(*first.size_wh, resize)
        self._rectify = ImageRectifier(camera, self.size_wh)
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
    def intrinsics(self) -> Intrinsics:
        """Pinhole, without distortion, of the images that ``image`` returns.

        Raises:
            SourceError: The recording says nothing about its camera and none was given.
        """
        return self.stored_camera.undistorted().scaled_to(*self.size_wh)

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
            SourceError: The file is missing or damaged, or not of the first readable one's size or bits.
            ValueError: ``camera`` is not a resized version of this one.
        """
        if not 0 <= index < len(self._paths):
            raise IndexError(f"frame must be in [0, {len(self._paths) - 1}], got {index}")
        image = self._rectify(self._read(self._paths[index]))
        if camera is None or (camera.width, camera.height) == self.size_wh:
            return image
        if self._stored_camera is not None:
            same = self.intrinsics.scaled_to(camera.width, camera.height)
            if not np.allclose(same.K, camera.K, rtol=0.01, atol=1.0):
                raise ValueError(
                    f"the camera must be that of {self.name} at another size, {_in_words(same)}, "
                    f"got {_in_words(camera)}"
                )
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
                    self._read(path)
                    continue
                self._check_size(path, size_wh)
                if states_16_bits(path):
                    self._check_may_be_16_bit(path)
            except SourceError as err:
                messages.append(str(err))
        return messages, num_skipped

    def _read(self, path: Path) -> NDArray[np.uint8]:
        image = read_image(path, lambda: self._bits_in(path))
        self._check_size(path, (image.shape[1], image.shape[0]))
        return image

    def _bits_in(self, path: Path) -> int | None:
        self._check_may_be_16_bit(path)
        return self._bit_depth

    def _check_may_be_16_bit(self, path: Path) -> None:
        if not self._is_16_bit:
            raise SourceError(
                f"{path} is a 16-bit image, the first readable image of the sequence is 8-bit: a depth image?"
            )

    def _check_size(self, path: Path, size_wh: tuple[int, int]) -> None:
        if size_wh != self._stored_wh:
            raise SourceError(
                f"{path} is {size_wh[0]}x{size_wh[1]}, "
                f"the first readable image of the sequence is {self._stored_wh[0]}x{self._stored_wh[1]}"
            )

    @property
    def doubt(self) -> str | None:
        """Why images can't be those of a moving camera in order of time, by true poses; None if fine."""
        truth = self._truth
        if truth is None or len(truth) < 2:
            return None
        # Where few images have a true pose, a turn from one to the next may be that of a second.
        is_next = np.diff(np.searchsorted(ns_to_seconds(self.times_ns), truth.t_s)) == 1
        forward = truth.T_world_cam[:, :3, 2]
        cosines = np.clip((forward[1:] * forward[:-1]).sum(axis=1)[is_next], -1.0, 1.0)
        turn_deg = float(np.degrees(np.median(np.arccos(cosines)))) if is_next.any() else 0.0
        if turn_deg <= _MOST_TURN_DEG:
            return None
        return (
            f"no stream: from one image to the next the camera turns by {turn_deg:.0f} degrees (median), and "
            "tracking needs images that show much the same, in the order in which they were taken"
        )

    def groundtruth(self) -> Trajectory | None:
        """Return the true camera poses, None where there are none.

        Times are exactly ``times_ns * 1e-9`` of the frames; frames without a true pose nearby are absent.
        """
        return self._truth


def _in_words(camera: Intrinsics) -> str:
    return (
        f"fx {camera.fx:.1f} fy {camera.fy:.1f} cx {camera.cx:.1f} cy {camera.cy:.1f} px "
        f"for {camera.width}x{camera.height}"
    )


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


def read_known_path(path: Path) -> Trajectory:
    """Return the path in a TUM file, or the true path of a sequence.

    Raises:
        SourceError: It can't be read, the sequence has none, or the file holds no pose.
    """
    is_tum = path.is_file() and path.suffix.lower() != ".json"
    truth = read_tum(path) if is_tum else open_truth(path)[0]
    if truth is None:
        raise SourceError(f"{path} is a sequence without a true path")
    if len(truth) == 0:
        raise SourceError(f"{path} must hold poses, got none")
    return truth


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
    return Trajectory(times_s[kept], np.array(poses), in_metres=truth.in_metres) if kept else None


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
    t_s = np.interp(truth.t_s[between], own_s, stream_s)
    return Trajectory(t_s, truth.T_world_cam[between], in_metres=truth.in_metres)


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
        path: Folder in the native, TUM, KITTI odometry, EuRoC, NeRF or COLMAP layout, a folder of images, or
            a ``transforms*.json`` file.
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
    first = _first_image(files.image_paths)
    width, height = first.size_wh
    camera = intrinsics.resolve(width, height) if isinstance(intrinsics, CameraSettings) else intrinsics
    if camera is None:
        camera = files.camera(width, height)
    if camera is not None:
        check_size(camera, width, height, files.name)
        camera.check_possible(files.name)
    stop = None if max_frames is None else max_frames * stride
    return Sequence(files, camera, first, resize, slice(None, stop, stride))


@dataclass(frozen=True)
class _FirstImage:
    size_wh: tuple[int, int]
    is_16_bit: bool


def _first_image(paths: tuple[Path, ...]) -> _FirstImage:
    """Return what the first image that can be read is like: one damaged file does not spoil the rest."""
    first_error: SourceError | None = None
    for path in paths[: _MAX_BAD_AT_START + 1]:
        is_16_bit = False

        def asked_of_16_bit() -> None:
            nonlocal is_16_bit
            is_16_bit = True

        try:
            height, width = read_image(path, asked_of_16_bit).shape[:2]
        except SourceError as err:
            first_error = first_error or err
        else:
            return _FirstImage((width, height), is_16_bit)
    assert first_error is not None, "a layout has at least one image"
    raise first_error
