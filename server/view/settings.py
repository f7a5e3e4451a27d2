"""Settings of the viewer."""

import re
from dataclasses import dataclass, field, fields
from typing import Literal

#: Sizes the viewer understands.
_MEMORY = re.compile(r"\d+(\.\d+)? ?(B|[kMGT]B|[KMGT]iB)|(100|\d{1,2}(\.\d+)?)%")

ViewChoice = Literal["auto", "native", "web", "file", "none"]

#: Settings that do nothing where the view is not among these.
_VIEWS_OF: dict[str, tuple[ViewChoice, ...]] = {
    "port": ("auto", "native", "web"),
    "web_port": ("web",),
    "leave_open": ("auto", "native"),
    "memory_limit": ("auto", "native", "web"),
    "image_rate_hz": ("auto", "native", "web", "file"),
    "jpeg_quality": ("auto", "native", "web", "file"),
}


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """What is shown where.

    Attributes:
        view: ``native`` opens a window, ``web`` serves a page on loopback, ``file`` only writes ``run.rrd``,
            ``none`` shows nothing, ``auto`` is ``native`` where there is a display and ``file`` elsewhere.
        port: Where the viewer takes the stream, on loopback.
        web_port: Where the web page is, on loopback.
        leave_open: Leave a native window open when the source has come to its end.
        memory_limit: What a viewer may keep before it forgets the oldest data.
        image_rate_hz: Images shown per second at most; poses and plots are always complete.
        jpeg_quality: Quality of the images in the viewer and in ``run.rrd``.
    """

    view: ViewChoice = field(
        default="auto",
        metadata={
            "help": "viewer: auto (window if there is a display, else file), native, web, file or none"
        },
    )
    port: int = field(
        default=9876, metadata={"flag": "viewer_port", "help": "loopback port the viewer takes the stream on"}
    )
    web_port: int = field(default=9090, metadata={"help": "loopback port of the web viewer's page"})
    leave_open: bool = field(
        default=True,
        metadata={"flag": "viewer_leave_open", "help": "leave the window open when the source has ended"},
    )
    memory_limit: str = field(
        default="1GB", metadata={"flag": "viewer_memory", "help": "memory a viewer may use, such as 1GB"}
    )
    image_rate_hz: float = field(
        default=10.0, metadata={"flag": "viewer_image_rate_hz", "help": "images a second shown at most"}
    )
    jpeg_quality: int = field(
        default=80, metadata={"flag": "viewer_jpeg_quality", "help": "JPEG quality of shown images"}
    )

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: A value is out of range.
        """
        for name, port in (("viewer_port", self.port), ("web_port", self.web_port)):
            if not 1 <= port <= 65535:
                raise ValueError(f"{name} must be in [1, 65535], got {port}")
        if self.port == self.web_port:
            raise ValueError(f"viewer_port and web_port must differ, got {self.port} for both")
        if not _MEMORY.fullmatch(self.memory_limit):
            raise ValueError(
                f"memory_limit must be a number of MB, GB ... or a percentage up to 100%, such as 1GB, "
                f"got {self.memory_limit!r}"
            )
        if not 0.1 <= self.image_rate_hz <= 60:
            raise ValueError(f"image_rate_hz must be in [0.1, 60], got {self.image_rate_hz}")
        if not 10 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality must be in [10, 100], got {self.jpeg_quality}")

    def without_effect(self) -> list[str]:
        """Return the flags' names of values off their default that change nothing in this view."""
        return [
            str(entry.metadata.get("flag", entry.name))
            for entry in fields(self)
            if getattr(self, entry.name) != entry.default
            and self.view not in _VIEWS_OF.get(entry.name, (self.view,))
        ]
