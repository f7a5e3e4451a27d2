"""Which frames an agent sends, and how fast."""

from dataclasses import dataclass, field
from typing import Literal

from semcast.common.camera_settings import CameraSettings
from semcast.common.layouts.layout import Layout
from semcast.common.playback import check_playback

Pace = Literal["recorded", "rate", "receiver"]
Repeat = Literal["once", "loop", "swing"]


@dataclass(frozen=True, kw_only=True)
class SourceSettings:
    """Where frames come from.

    Raises:
        ValueError: A value is out of range, or values contradict each other.
    """

    source: str = field(
        metadata={
            "help": "folder of a recorded sequence or of images, video file, number or device (/dev/video0) "
            "of a camera, or address of a network camera such as rtsp://host/stream"
        }
    )
    layout: Layout = field(
        default="auto",
        metadata={"help": "layout of the folder: native, tum, kitti, euroc, transforms, colmap, folder"},
    )
    camera: CameraSettings = field(default=CameraSettings(), metadata={"help": "intrinsics"})
    resize: float = field(default=1.0, metadata={"help": "factor on the image size; intrinsics follow"})
    stride: int = field(default=1, metadata={"help": "send every n-th frame"})
    max_frames: int | None = field(default=None, metadata={"help": "frames sent at most"})
    pace: Pace = field(
        default="recorded",
        metadata={
            "help": "recorded: at recorded times, or as the camera delivers; rate: at --rate-hz; "
            "receiver: as fast as the receiver takes them (replay mode)"
        },
    )
    rate_hz: float | None = field(
        default=None,
        metadata={
            "help": "frames per second for --pace rate; with another pace, those at which a folder without "
            "times was taken (default 10)"
        },
    )
    repeat: Repeat = field(
        default="once", metadata={"help": "at the end: stop, start again (loop), or go back (swing)"}
    )

    def __post_init__(self) -> None:
        if not self.source:
            raise ValueError("source must name a folder, a video, a camera or an address, got nothing")
        check_playback(
            resize=self.resize, stride=self.stride, max_frames=self.max_frames, rate_hz=self.rate_hz
        )
        if self.pace == "rate" and self.rate_hz is None:
            raise ValueError("rate_hz must be given for pace 'rate', got None")

    def paced_hz(self, own_hz: float) -> float:
        """Return frames per second of a source that gives ``own_hz``; 0 where the receiver sets the pace."""
        if self.pace == "receiver":
            return 0.0
        return self.rate_hz if self.pace == "rate" and self.rate_hz is not None else own_hz
