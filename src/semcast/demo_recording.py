"""What the demo has to know of the recording it plays: a sequence, or a video file."""

import contextlib
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError
from semcast.common.playback import usual_period_ns
from semcast.common.sequence import Sequence, open_sequence


@dataclass(frozen=True)
class DemoRecording:
    """A recording that an agent can play.

    Attributes:
        path: Folder, ``transforms.json`` or video.
        name: For people.
        num_frames: Images in it; None where a video does not say.
        rate_hz: Usual images a second.
        image: ``(H, W, 3)`` uint8 RGB, undistorted: the first one that can be read.
        doubt: Why it may be no stream of images, or None.
        is_video: It has no true path, and no images that a server could compare with.
    """

    path: Path
    name: str
    num_frames: int | None
    rate_hz: float
    image: NDArray[np.uint8]
    doubt: str | None = None
    is_video: bool = False


def look_at(path: Path, camera: CameraSettings) -> DemoRecording:
    """Open a recording and say what it is.

    Args:
        path: Folder of a sequence, ``transforms.json``, or a video file.
        camera: Of a recording that does not say it.

    Raises:
        SourceError: It can't be read, or its camera is unknown.
    """
    if path.is_file() and path.suffix.lower() != ".json":
        return _look_at_video(path, camera)
    sequence = open_sequence(path, camera)
    _ = sequence.intrinsics
    rate_hz = 1e9 / usual_period_ns(sequence.times_ns)
    image = _first_image(sequence)
    return DemoRecording(path, sequence.name, len(sequence), rate_hz, image, sequence.doubt)


def _look_at_video(path: Path, camera: CameraSettings) -> DemoRecording:
    source = open_source(SourceSettings(source=str(path), camera=camera))
    try:
        image = next(source.frames(threading.Event())).image
        return DemoRecording(path, source.name, source.num_frames, source.rate_hz, image, is_video=True)
    finally:
        source.close()


def _first_image(sequence: Sequence) -> NDArray[np.uint8]:
    """Return the first image that can be read: agents leave out those before it.

    Raises:
        SourceError: None can be read.
    """
    for index in range(len(sequence) - 1):
        with contextlib.suppress(SourceError):
            return sequence.image(index)
    return sequence.image(len(sequence) - 1)
