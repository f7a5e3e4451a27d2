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
(landmark id, keyframe id, x, y), and the parts of the map that frames and landmarks are in. It calls
``write_run`` once at the end and feeds an ``ImageWriter``.
"""

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.mailbox import Mailbox
from semcast.common.npz_file import read_npz, write_npz
from semcast.common.shapes import check_shape

logger = logging.getLogger(__name__)

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

FORMAT = 1
#: Frames that may wait for a map to begin, whose start can make keyframes of them.
MAX_PROVISIONAL = 300
MAX_UNPACKED_BYTES = 4 * 1024**3


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
assert {*_ARRAYS, "intrinsics"} == {f.name for f in fields(RunData)}
#: Arrays that older runs lack -> those they go with; such a run counts as one part.
_ADDED = {"frame_submap": "frame_ids", "landmark_submap": "landmark_ids"}


def write_run(folder: Path, data: RunData) -> None:
    """Write ``reconstruction.npz`` into a run folder, whole or not at all.

    Raises:
        SourceError: The folder can't be made or the file can't be written.
    """
    path = folder / RECONSTRUCTION_NAME
    header = {"format": FORMAT, "intrinsics": data.intrinsics.to_dict()}
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
        return RunData(intrinsics=Intrinsics.from_dict(header["intrinsics"]), **arrays)
    except Exception as err:  # what is in place of an array or a number fails in many ways
        raise SourceError(f"{path} is damaged: {err}") from err


def image_name(frame_id: int) -> str:
    """Return the file name of a frame's decoded image."""
    return f"{frame_id:06d}.jpg"


def read_image_paths(folder: Path) -> dict[int, Path]:
    """Return frame id to path of the decoded images a run kept; empty where it kept none."""
    images = folder / IMAGES_NAME
    if not images.is_dir():
        return {}
    return {int(p.stem): p for p in sorted(images.glob("*.jpg")) if p.stem.isdecimal()}


@dataclass(frozen=True)
class _Image:
    frame_id: int
    image: NDArray[np.uint8]
    provisional: bool


class ImageWriter:
    """Writes decoded images into ``images/`` on its own thread, so that tracking does not wait for the disk.

    A full disk, or whatever else keeps an image from being written, is reported once; the stream goes on
    without images, which are counted as dropped.

    Args:
        folder: The run folder.
        lossless: Wait when the queue is full; otherwise the image is dropped and counted.
        quality: JPEG quality.
        capacity: Images that may wait.
        on_error: Is told in a line why the run goes on without images.

    Raises:
        SourceError: The folder can't be made.
    """

    def __init__(
        self,
        folder: Path,
        *,
        lossless: bool,
        quality: int = 95,
        capacity: int = 8,
        on_error: Callable[[str], None] | None = None,
    ) -> None:
        self._images = folder / IMAGES_NAME
        self._wait_s = None if lossless else 0.0
        self._quality = quality
        self._on_error = on_error
        self._box: Mailbox[_Image] = Mailbox(capacity, "all")
        #: What is kept of the provisional images written so far; not in the queue, which may be full.
        self._settled: deque[tuple[int, frozenset[int]]] = deque()
        self._num_put = 0
        self.num_written = 0
        # Each belongs to one thread: that of the caller, and that of the writer.
        self._num_refused = self._num_failed = 0
        try:
            self._images.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            raise SourceError(f"{self._images} can't be written: {err}") from err
        self._provisional: deque[int] = deque()
        self._thread = threading.Thread(target=self._run, name="semcast-images", daemon=True)
        self._thread.start()

    @property
    def num_dropped(self) -> int:
        """Images that found no room in the queue, or could not be written."""
        return self._num_refused + self._num_failed

    def put(self, frame_id: int, image: NDArray[np.uint8], *, provisional: bool = False) -> None:
        """Queue one image; the caller must not change it afterwards. After ``close`` it is ignored.

        Args:
            frame_id: Names the file.
            image: ``(H, W, 3)`` uint8 RGB.
            provisional: ``settle`` will say whether it is kept; of many only the newest are.
        """
        if self._box.put(_Image(frame_id, image, provisional), self._wait_s) is not None:
            self._num_put += 1
        elif not self._box.closed:
            self._num_refused += 1

    def settle(self, kept: Collection[int]) -> None:
        """Remove the provisional images of all other frames put so far. Returns at once."""
        self._settled.append((self._num_put, frozenset(kept)))

    def _run(self) -> None:
        num_taken = 0
        while (item := self._box.get()) is not None:
            while self._settled and self._settled[0][0] <= num_taken:
                self._drop_provisional(self._settled.popleft()[1])
            num_taken += 1
            if self._num_failed:
                self._num_failed += 1
                continue
            try:
                self._write(item)
            except Exception as err:
                self._num_failed += 1
                self._remove(item.frame_id)  # a part of it may be there
                text = f"{self._images} can't be written: {str(err) or type(err).__name__}"
                logger.warning(
                    "%s; the run goes on without images",
                    text,
                    exc_info=not isinstance(err, (OSError, cv2.error)),
                )
                if self._on_error is not None:
                    self._on_error(text)
        while self._settled:
            self._drop_provisional(self._settled.popleft()[1])
        self._drop_provisional(frozenset())

    def _write(self, item: _Image) -> None:
        bgr = cv2.cvtColor(item.image, cv2.COLOR_RGB2BGR)
        good, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        if not good:
            raise OSError("OpenCV could not encode the image")
        (self._images / image_name(item.frame_id)).write_bytes(data.tobytes())
        self.num_written += 1
        if item.provisional:
            self._provisional.append(item.frame_id)
            if len(self._provisional) > MAX_PROVISIONAL:
                self._remove(self._provisional.popleft())

    def _drop_provisional(self, kept: Collection[int]) -> None:
        for frame_id in self._provisional:
            if frame_id not in kept:
                self._remove(frame_id)
        self._provisional.clear()

    def _remove(self, frame_id: int) -> None:
        with contextlib.suppress(OSError):
            (self._images / image_name(frame_id)).unlink()

    def close(self, deadline_s: float = 30.0) -> None:
        """Write what waits and end the thread; what is not written by the deadline is dropped. Idempotent."""
        self._box.close()
        self._thread.join(deadline_s)
        if num_left := self._box.clear():
            self._num_refused += num_left
            logger.warning("%d images are not written: the disk is too slow", num_left)

    def __enter__(self) -> "ImageWriter":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
