"""Frames for the agent: one interface over recorded sequences, video files and live cameras."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semcast.agent.source_settings import SourceSettings
from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.playback import usual_period_ns
from semcast.common.ros_bag_files import check_no_ros_bag
from semcast.common.sequence import Sequence, open_sequence

logger = logging.getLogger(__name__)

#: Unreadable images in a row that end a source; fewer are left out.
MAX_BAD_IN_A_ROW = 10


@dataclass(frozen=True)
class SourceFrame:
    """One frame on its way to the encoder.

    Attributes:
        frame_id: Index in the recording, or count of frames grabbed; strictly increasing.
        t_source_ns: Recorded time; that of capture for live cameras.
        t_capture_ns: ``time.monotonic_ns`` when it was due or grabbed.
        stored: ``(H, W, 3)`` uint8 RGB, as it came where there is ``rectify``.
        final: Last frame of a finite source.
        rectify: Undistorts and resizes what is stored; None where that was done.
    """

    frame_id: int
    t_source_ns: int
    t_capture_ns: int
    stored: NDArray[np.uint8]
    final: bool = False
    rectify: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """``(H, W, 3)`` uint8 RGB, undistorted and resized when it is first asked for: not all are sent."""
        return self.stored if self.rectify is None else self.rectify(self.stored)


class Source(Protocol):
    """Where frames come from. ``frames`` belongs to one thread."""

    @property
    def name(self) -> str:
        """For people."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the frames, without distortion."""

    @property
    def stored_camera(self) -> Intrinsics:
        """Of the images before they are undistorted and resized."""

    @property
    def num_frames(self) -> int | None:
        """Of a finite source whose length is known."""

    @property
    def last_frame_id(self) -> int | None:
        """Of the last frame, where ``num_frames`` is known."""

    @property
    def rate_hz(self) -> float:
        """Frames per second it aims at; 0 where the receiver sets the pace."""

    @property
    def num_unreadable(self) -> int:
        """Frames that were left out so far, as they can't be read or have another size."""

    def frames(self, stop: threading.Event) -> Iterator[SourceFrame]:
        """Yield frames when they are due, until the end or until ``stop`` is set.

        Raises:
            SourceError: Nothing can be read any more.
        """

    def close(self) -> None:
        """Free the camera or file. Idempotent."""


class Pacer:
    """Waits until a frame is due.

    Args:
        settings: ``pace`` and ``rate_hz``.
        clock_s: Monotonic clock.
        wait: Waits so many seconds; True ends the waiting for good.
    """

    def __init__(
        self,
        settings: SourceSettings,
        wait: Callable[[float], bool],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        self._wait = wait
        self._clock_s = clock_s
        self._start_s: float | None = None
        self._first_ns = 0
        self._count = 0

    def until_due(self, t_source_ns: int) -> bool:
        """Wait for the time of the next frame; False when stopped. The first frame is due at once."""
        settings = self._settings
        if self._start_s is None:
            self._start_s, self._first_ns = self._clock_s(), t_source_ns
        due_s = self._start_s
        if settings.pace == "rate" and settings.rate_hz is not None:
            due_s += self._count / settings.rate_hz
        elif settings.pace == "recorded":
            due_s += (t_source_ns - self._first_ns) * 1e-9
        self._count += 1
        remaining_s = due_s - self._clock_s()
        return not self._wait(max(0.0, remaining_s))


def playback_order(num_frames: int, repeat: str) -> Iterator[int]:
    """Yield positions in a recording: once, over and over, or forth and back for ever."""
    yield from range(num_frames)
    while repeat == "loop":
        yield from range(num_frames)
    while repeat == "swing":
        yield from range(num_frames - 2, -1, -1) if num_frames > 1 else (0,)
        yield from range(1, num_frames)


class RecordedSource:
    """A recorded sequence, played in time.

    The first pass has the ids and times of the recording; further ones count both on.

    Args:
        sequence: What to play.
        settings: Pace and repetition.
    """

    def __init__(self, sequence: Sequence, settings: SourceSettings) -> None:
        self._sequence = sequence
        self._settings = settings
        #: Of the frames, without distortion.
        self.intrinsics = sequence.intrinsics
        if doubt := sequence.doubt:
            logger.warning("%s is %s", sequence.name, doubt)
        self._num_unreadable = 0
        # Repeated, there is always another frame for one that is left out.
        self._length = self._readable_length() if settings.repeat == "once" else len(sequence)

    def _readable_length(self) -> int:
        """Return how many images there are without the unreadable ones at the end, if these are few."""
        length, refused = len(self._sequence), list[tuple[int, SourceError]]()
        for index in range(length - 1, max(-1, length - 1 - MAX_BAD_IN_A_ROW), -1):
            try:
                self._sequence.image(index)
            except SourceError as err:
                refused.append((int(self._sequence.frame_ids[index]), err))
            else:
                for frame_id, refusal in reversed(refused):
                    self._leave_out(frame_id, refusal)
                return index + 1
        return length

    def _leave_out(self, frame_id: int, refusal: SourceError) -> None:
        self._num_unreadable += 1
        logger.warning("frame %d is left out: %s", frame_id, refusal)

    @property
    def num_unreadable(self) -> int:
        """Images that were left out so far."""
        return self._num_unreadable

    @property
    def name(self) -> str:
        """Folder name."""
        return self._sequence.name

    @property
    def stored_camera(self) -> Intrinsics:
        """Of the images as recorded."""
        return self._sequence.stored_camera

    @property
    def num_frames(self) -> int | None:
        """Frames of one pass, or as many as were asked for; None when it is repeated for ever."""
        return self._length if self._settings.repeat == "once" else self._settings.max_frames

    @property
    def last_frame_id(self) -> int | None:
        """Of the last frame where none is left out; None when there is no last one."""
        count, ids = self.num_frames, self._sequence.frame_ids
        if count is None:
            return None
        # From the second pass on ids are counted on.
        return int(ids[count - 1]) if count <= len(ids) else int(ids[-1]) + count - len(ids)

    @property
    def rate_hz(self) -> float:
        """Usual frames per second at this pace."""
        return self._settings.paced_hz(1e9 / usual_period_ns(self._sequence.times_ns))

    def frames(self, stop: threading.Event) -> Iterator[SourceFrame]:
        """Yield frames when they are due; unreadable ones are left out.

        Raises:
            SourceError: ``MAX_BAD_IN_A_ROW`` images in a row can't be read, or the last one of the only pass
                no longer.
        """
        pacer = Pacer(self._settings, stop.wait)
        times_ns = self._sequence.times_ns
        last = self._length - 1
        once, sent = self._settings.repeat == "once", 0
        period_ns = round(usual_period_ns(times_ns))
        frame_id, t_source_ns, previous, bad = -1, 0, -1, 0
        for count, index in enumerate(playback_order(self._length, self._settings.repeat)):
            if count <= last:
                frame_id, t_source_ns = int(self._sequence.frame_ids[index]), int(times_ns[index])
            else:
                step_ns = abs(int(times_ns[index] - times_ns[previous])) if abs(index - previous) == 1 else 0
                frame_id, t_source_ns = frame_id + 1, t_source_ns + (step_ns or period_ns)
            previous = index
            final = count == last if once else sent + 1 == self._settings.max_frames
            try:
                image = self._sequence.image(index)
            except SourceError as err:
                bad += 1
                if bad >= MAX_BAD_IN_A_ROW:
                    raise SourceError(f"{bad} images in a row can't be used, the last one: {err}") from err
                if final and once:
                    raise
                self._leave_out(frame_id, err)
                # In their time, too: a drive or a share that is back in a moment ends nothing.
                if not pacer.until_due(t_source_ns):
                    return
                continue
            bad = 0
            sent += 1
            if not pacer.until_due(t_source_ns):
                return
            yield SourceFrame(frame_id, t_source_ns, time.monotonic_ns(), image, final)
            if final:
                return

    def close(self) -> None:
        """Nothing to free."""


def is_camera_number(text: str) -> bool:
    """Tell whether this is a number under which OpenCV may know a camera: it takes 32 bits."""
    return text.isascii() and text.isdecimal() and len(text) < 10


def is_camera_device(text: str) -> bool:
    """Tell whether this is a camera's file on Linux, such as ``/dev/video0``, plugged in or not."""
    path = Path(text)
    in_dev = text.startswith("/dev/") and not text.startswith("/dev/shm/")
    return in_dev and not (path.is_file() or path.is_dir())


def is_live(text: str) -> bool:
    """Tell whether a source is a camera: by its address, number or device.

    A number is one unless a folder or file has that name.
    """
    return "://" in text or (is_camera_number(text) and not Path(text).exists()) or is_camera_device(text)


def open_source(settings: SourceSettings) -> Source:
    """Open what ``settings.source`` names.

    What ``is_live`` is a camera, a folder or ``.json`` file a recording, any other file a video.

    Raises:
        SourceError: It can't be opened, or its camera is unknown.
    """
    source = _opened(settings)
    wanted_hz, own_hz = settings.rate_hz, source.rate_hz * settings.stride
    if wanted_hz is not None and settings.pace == "recorded" and abs(own_hz - wanted_hz) > 0.01 * wanted_hz:
        logger.warning(
            "rate_hz: no effect on %s, whose images have times of their own; --pace rate sends at it",
            source.name,
        )
    if settings.layout != "auto" and not isinstance(source, RecordedSource):
        logger.warning("layout: no effect on %s, which is no folder", source.name)
    return source


def _opened(settings: SourceSettings) -> Source:
    from semcast.agent.video import LiveSource, VideoSource

    text = settings.source
    path = Path(text)
    if is_live(text):
        return LiveSource(settings)
    check_no_ros_bag(path)
    if path.is_file() and path.suffix.lower() != ".json":
        return VideoSource(settings)
    # How fast a recording is played says nothing of when its images were taken.
    recorded_hz = None if settings.pace == "rate" else settings.rate_hz
    sequence = open_sequence(
        path,
        settings.camera,
        settings.layout,
        settings.resize,
        settings.stride,
        settings.max_frames if settings.repeat == "once" else None,
        recorded_hz or 10.0,
    )
    return RecordedSource(sequence, settings)
