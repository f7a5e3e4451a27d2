"""Video files, webcams and network cameras, read by OpenCV."""

import contextlib
import logging
import math
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.agent.source import Pacer, SourceFrame, is_camera_device, is_camera_number
from semcast.agent.source_settings import SourceSettings
from semcast.agent.video_times import VideoTimes
from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import HOW_TO_GIVE, check_size
from semcast.common.errors import SourceError
from semcast.common.image_file import as_rgb
from semcast.common.layouts.files import IMAGE_SUFFIXES
from semcast.common.sequence import ImageRectifier, resized_wh

logger = logging.getLogger(__name__)

_REOPEN_AFTER_S = 1.0
#: Longest time to throw old images away before a camera's first is sent.
_SKIP_S = 2.0
_OPEN_TIMEOUT_MS = 5000
#: Share of a beat by which an image of a camera may come before it: they are not that steady, and one that is
#: left out for it is followed by one that is nearly a period late.
_EARLY = 0.25
#: What a camera takes as a password in its query or path: ``pwd=``, ``loginpas=``, ``password=``, ``token=``.
_SECRET = re.compile(r"([?&;/]\w*(?:pas|pwd|token|secret|key)\w*=)[^&;#]*", re.IGNORECASE)


def public_name(source: str) -> str:
    """Return a source's name without the password an address may hold, before its host or in its query.

    Names go to the server and into recordings.
    """
    if "://" not in source:
        return source
    scheme, rest = source.split("://", 1)
    shown = _SECRET.sub(r"\1***", rest.rsplit("@", 1)[-1])
    return f"{scheme}://{shown}"


def _why_not(source: str, live: bool) -> str:
    """Return what can be told about why a source can't be opened, to end the sentence that says so."""
    if not live:
        if source.endswith(".mcap"):
            return ": 'semcast replay' takes recordings of a stream"
        return ": it is in no format of videos that OpenCV reads, or it is damaged or was cut off"
    if "://" in source:
        return ": no stream came from there; are address and password right?"
    device = Path(f"/dev/video{int(source)}" if is_camera_number(source) else source)
    if sys.platform != "linux":
        return ""
    if not device.exists():
        return f": there is no {device}"
    if not os.access(device, os.R_OK | os.W_OK):
        return f": this user may not use {device}, which mostly takes being in the group 'video'"
    return f": {device} gives no images; it may be in use, or no camera"


def open_capture(source: str, *, live: bool) -> cv2.VideoCapture:
    """Open a video file, or a camera by its number, device or address.

    Args:
        source: File, number, device or address.
        live: It is a camera.

    Raises:
        SourceError: It is a picture, or can't be opened; one at an address is waited for for five seconds.
    """
    try:
        source.encode()
    except UnicodeEncodeError as err:  # OpenCV ends the process
        raise SourceError(f"the name of {public_name(source)!r} must be text in UTF-8") from err
    if not live:
        if Path(source).suffix.lower() in IMAGE_SUFFIXES:  # OpenCV would take it for a video
            raise SourceError(f"{source} is a single picture: give the folder of pictures that it is in")
        capture = cv2.VideoCapture(source)
    elif is_camera_number(source):
        capture = cv2.VideoCapture(int(source))
    elif is_camera_device(source):
        capture = cv2.VideoCapture(source, cv2.CAP_V4L2)
    else:
        # Without limits a camera that is switched off holds the thread for half a minute.
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            _OPEN_TIMEOUT_MS,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            _OPEN_TIMEOUT_MS,
        ]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
    if not capture.isOpened():
        capture.release()
        what = "camera" if live else "video"
        raise SourceError(f"{what} {public_name(source)} can't be opened{_why_not(source, live)}")
    if live:
        # The driver's queue only makes frames older.
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture


def _read(capture: cv2.VideoCapture) -> NDArray[np.uint8] | None:
    good, image = capture.read()
    return as_rgb(image) if good and image is not None else None


def _stated_hz(capture: cv2.VideoCapture, else_hz: float) -> float:
    """Return the images a second that a file or camera says it has, where that can be."""
    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if 0.1 <= fps <= 1000.0 else else_hz


class _Captured:
    """What video files and live cameras share: the capture, the camera model, the way to a frame."""

    def __init__(self, settings: SourceSettings, live: bool, beside: Path | None) -> None:
        self._settings = settings
        self._capture: cv2.VideoCapture | None = open_capture(settings.source, live=live)
        name = public_name(settings.source)
        try:
            first = _read(self._capture)
            if first is None:
                # Of an address FFmpeg reads from front to back, and opens what it then finds no image in.
                is_on_web = name.startswith(("http://", "https://"))
                why = ": a video at an address must have its index at its beginning; else download it"
                raise SourceError(f"{name} gives no images{why if is_on_web else ''}")
            height, width = first.shape[:2]
            camera = settings.camera.resolve(width, height)
            if camera is None and beside is not None:
                camera = Intrinsics.load(beside)
            if camera is None:
                raise SourceError(f"the camera of {name} is unknown: {HOW_TO_GIVE}")
            check_size(camera, width, height, name)
            camera.check_possible(name)
            size_wh = resized_wh(width, height, settings.resize)
        except SourceError:
            self.close()
            raise
        self._stored_wh = (width, height)
        #: Of the images as they come.
        self.stored_camera = camera
        #: Of the frames, without distortion.
        self.intrinsics = camera.undistorted().scaled_to(*size_wh)
        self._rectify = ImageRectifier(camera, size_wh)
        self._first: NDArray[np.uint8] | None = first

    @property
    def num_unreadable(self) -> int:
        """0: a frame that can't be decoded is one that never came."""
        return 0

    def _usable(self, image: NDArray[np.uint8]) -> bool:
        return (image.shape[1], image.shape[0]) == self._stored_wh

    def close(self) -> None:
        """Free the camera or file. Idempotent."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def calibration_beside(path: Path) -> Path | None:
    """Return the file beside a video that holds its intrinsics, if there is one."""
    files = (path.with_suffix(".json"), path.parent / "intrinsics.json")
    return next((file for file in files if file.is_file()), None)


class VideoSource(_Captured):
    """A video file, played in time; intrinsics may lie beside it as ``<name>.json`` or ``intrinsics.json``.

    Raises:
        SourceError: It can't be read, its camera is unknown, or it is to be played backwards.
    """

    def __init__(self, settings: SourceSettings) -> None:
        path = Path(settings.source)
        if settings.repeat == "swing":
            raise SourceError("a video can't be played backwards: use repeat 'once' or 'loop'")
        super().__init__(settings, live=False, beside=calibration_beside(path))
        assert self._capture is not None
        self._fps = _stated_hz(self._capture, settings.rate_hz or 30.0)
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self._stored_frames = count if count > 0 else None
        self._is_cut = False

    @property
    def name(self) -> str:
        """File name."""
        return Path(self._settings.source).name

    @property
    def num_frames(self) -> int | None:
        """Frames that will be sent, where the file says it or, repeated, as many as were asked for."""
        most = self._settings.max_frames
        if self._settings.repeat != "once":
            return most
        if self._stored_frames is None:
            return None
        count = -(-self._stored_frames // self._settings.stride)
        return count if most is None else min(count, most)

    @property
    def last_frame_id(self) -> int | None:
        """Of the last frame that will be sent: ids are places in the file."""
        count = self.num_frames
        return None if count is None else max(0, count - 1) * self._settings.stride

    @property
    def rate_hz(self) -> float:
        """Frames per second at this pace."""
        return self._settings.paced_hz(self._fps / self._settings.stride)

    def _one_pass(self) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield what is left in the file, each image with its time in ns since the first one."""
        image, self._first = self._first, None
        image, stamp_ms = self._next() if image is None else (image, self._stamp_ms())
        times = VideoTimes(self._fps)
        while image is not None and self._capture is not None:
            following, following_ms = self._next()
            yield times.next_ns(stamp_ms, following_ms), image
            image, stamp_ms = following, following_ms
        if self._capture is not None:
            self._warn_if_cut(times)

    def _next(self) -> tuple[NDArray[np.uint8] | None, float]:
        """Return the next image in the file and its stamp in ms; None and no number at the end."""
        image = _read(self._capture) if self._capture is not None else None
        return image, math.nan if image is None else self._stamp_ms()

    def _stamp_ms(self) -> float:
        return math.nan if self._capture is None else float(self._capture.get(cv2.CAP_PROP_POS_MSEC))

    def _warn_if_cut(self, times: VideoTimes) -> None:
        """Say once that a good deal fewer frames could be read than the file has: a sign of damage."""
        stored = self._stored_frames
        if stored is None or self._is_cut or not times.is_cut(stored):
            return
        self._is_cut = True
        logger.warning(
            "%s: %d of its %d frames could be read; it may be damaged or trimmed",
            *(self.name, times.num_frames, stored),
        )

    def _images(self) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
        """Yield the frames that are to be sent, over all passes, with a running index and time in ns."""
        index, sent, most = 0, 0, self._settings.max_frames
        begun_ns = t_source_ns = 0
        while True:
            before = index
            for t_ns, image in self._one_pass():
                t_source_ns = begun_ns + t_ns
                if index % self._settings.stride == 0:
                    if most is not None and sent == most:
                        return
                    sent += 1
                    yield index, t_source_ns, image
                index += 1
            begun_ns = t_source_ns + round(1e9 / self._fps)
            if self._settings.repeat != "loop" or self._capture is None or index == before:
                return
            self._capture.release()
            self._capture = open_capture(self._settings.source, live=False)

    def frames(self, stop: threading.Event) -> Iterator[SourceFrame]:
        """Yield frames when they are due. One is read ahead, to know which is the last."""
        pacer = Pacer(self._settings, stop.wait)
        images = self._images()
        ahead = next(images, None)
        while ahead is not None and not stop.is_set():
            index, t_source_ns, image = ahead
            ahead = next(images, None)
            rectified = self._rectify(image)
            if not pacer.until_due(t_source_ns):
                return
            yield SourceFrame(index, t_source_ns, time.monotonic_ns(), rectified, ahead is None)


class LiveSource(_Captured):
    """A webcam or network camera. When it stops giving images it is opened again until it answers.

    Raises:
        SourceError: It can't be opened, or its camera is unknown.
    """

    def __init__(self, settings: SourceSettings) -> None:
        super().__init__(settings, live=True, beside=None)
        assert self._capture is not None
        self._first = None  # old by the time that frames are asked for
        self._fps = _stated_hz(self._capture, 30.0)
        self._trouble = ""  # why no image can be sent, as far as it was said

    @property
    def name(self) -> str:
        """Camera number or device, or the address without a password."""
        text = self._settings.source
        return public_name(text) if "://" in text else f"camera {text}"

    @property
    def num_frames(self) -> int | None:
        """As many as were asked for, or None: no end."""
        return self._settings.max_frames

    @property
    def last_frame_id(self) -> int | None:
        """Not known: a camera's images are counted as they come."""
        return None

    @property
    def rate_hz(self) -> float:
        """Frames per second at most."""
        given_hz = self._fps / self._settings.stride
        wanted_hz = self._settings.rate_hz if self._settings.pace == "rate" else None
        return given_hz if wanted_hz is None else min(given_hz, wanted_hz)

    def frames(self, stop: threading.Event) -> Iterator[SourceFrame]:
        """Yield frames as they are grabbed, at most ``rate_hz`` a second with pace ``rate``."""
        grabbed, sent, due_ns = -1, 0, 0
        interval_ns = 0
        if self._settings.pace == "rate" and self._settings.rate_hz is not None:
            interval_ns = round(1e9 / self._settings.rate_hz)
        most = self._settings.max_frames
        self._skip_what_waited()
        while not stop.is_set() and (most is None or sent < most):
            image = _read(self._capture) if self._capture is not None else None
            now_ns = time.monotonic_ns()
            if image is None or not self._usable(image):
                self._reopen(stop, "gives no images any more" if image is None else self._other_size(image))
                continue
            if self._trouble:
                logger.info("%s gives images again", self.name)
                self._trouble = ""
            grabbed += 1
            if grabbed % self._settings.stride or now_ns < due_ns - _EARLY * interval_ns:
                continue
            # On the beat, or where that was missed from now on: nothing is made up for in a burst.
            due_ns = due_ns + interval_ns if now_ns - due_ns < interval_ns else now_ns + interval_ns
            sent += 1
            yield SourceFrame(grabbed, now_ns, now_ns, image, sent == most, self._rectify)

    def _skip_what_waited(self) -> None:
        """Throw away images that waited in the driver while nobody took them: their time is not known.

        They come at once; the first that has to be waited for is new.
        """
        wait_s = 0.5 / self._fps
        begun_s = since_s = time.monotonic()
        while self._capture is not None and since_s - begun_s < _SKIP_S and self._capture.grab():
            now_s = time.monotonic()
            if now_s - since_s > wait_s:
                return
            since_s = now_s

    def _other_size(self, image: NDArray[np.uint8]) -> str:
        """Say that images have another size than the stream was begun with; its receivers know that one."""
        (width, height), (rows, columns) = self._stored_wh, image.shape[:2]
        return f"gives {columns}x{rows} images, must give {width}x{height} as at its start, or start anew"

    def _reopen(self, stop: threading.Event, trouble: str) -> None:
        if trouble != self._trouble and self._capture is not None:
            logger.warning("%s %s, trying again", self.name, trouble)
            self._trouble = trouble
        self.close()
        if not stop.wait(_REOPEN_AFTER_S):
            with contextlib.suppress(SourceError):
                self._capture = open_capture(self._settings.source, live=True)
