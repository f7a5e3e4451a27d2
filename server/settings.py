"""Settings of the server process."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from semcast.common.camera_settings import CameraSettings
from semcast.common.codec import PRECISION_HELP, Device, Modulation, Precision
from semcast.common.cores import check_threads, usable_cores
from semcast.common.keys import DEFAULT_AGENT_ID, check_agent_id
from semcast.common.network_settings import HubSettings
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.marker_settings import MarkerSettings
from semcast.server.view.settings import ViewSettings

logger = logging.getLogger(__name__)

#: When the depth of keyframes is estimated.
DenseWhen = Literal["auto", "live", "end", "none"]
#: Which decoded images are kept.
SavedImages = Literal["none", "keyframes", "all"]
#: With fewer cores the estimation of depth would keep frames waiting.
_CORES_FOR_LIVE_DEPTH = 4


def check_save_images(save_images: SavedImages, out: Path | None) -> None:
    """Check that images to be kept have a folder.

    Raises:
        ValueError: They have none.
    """
    if save_images != "none" and out is None:
        raise ValueError(f"save_images needs out, got save_images={save_images!r} without a folder")


@dataclass(frozen=True, kw_only=True)
class ServerSettings:
    """The server process.

    Attributes:
        agent_id: Whose stream.
        network: Where the processes meet.
        mode: ``live`` takes the newest frame and drops the others; ``replay`` loses none and repeats exactly.
        max_age_ms: Live frames older than this are dropped, but for a source's last one.
        out: Folder for outputs, or None.
        codec: Codec to load before the server reports itself ready; others are loaded when they arrive. A
            file of weights takes the place of the shipped ones of its codec.
        modulation: Of that codec.
        threads: CPU threads of the decoder.
        precision: What a learned decoder computes in.
        device: Where the decoder runs.
        reference: The recorded sequence the agent sends, for PSNR and true path.
        camera: Of the reference, where it does not say it or the agent uses another.
        bundle: Where bundle adjustment runs: a process of its own, or inline.
        checkpoint_interval_s: How much of the map a killed server may lose.
        resume: Go on with the map in ``out`` when it belongs to the same stream.
        record: Recording to write of everything that is sent, or None.
        save_images: Which decoded images to keep in ``out``, for exports.
        dense_cloud: Whether and when the depth of keyframes is estimated too: ``live`` in the time that
            tracking and mapping leave, at the ``end`` of the stream, ``auto``: live on four cores or more.
        keep_running: Go on after the source's last frame and wait for the next agent.
        idle_timeout_s: End when nothing arrives for so long after the first frame.
        duration_s: End after so long.
        marker: Tells the metre.
        reconstruction: Tracking and mapping.
        view: Viewer.
    """

    agent_id: str = field(default=DEFAULT_AGENT_ID, metadata={"help": "name of the agent to serve"})
    network: HubSettings = field(default=HubSettings(), metadata={"help": "where the processes meet"})
    mode: Literal["live", "replay"] = field(
        default="live",
        metadata={"help": "live: newest frame wins, drops are counted; replay: no frame lost, deterministic"},
    )
    max_age_ms: float = field(
        default=1000.0, metadata={"help": "live frames older than this are dropped, in milliseconds"}
    )
    out: Path | None = field(default=None, metadata={"help": "folder for trajectory, map, summary, run.rrd"})
    codec: str | None = field(
        default=None,
        metadata={
            "help": "codec to have ready at once, any other is loaded when it arrives; the agent's "
            ".safetensors file where it has weights of its own"
        },
    )
    modulation: Modulation = field(default="16qam", metadata={"help": "modulation of that codec"})
    threads: int = field(default=1, metadata={"help": "CPU threads of the decoder"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    device: Device = field(default="auto", metadata={"help": "device of the decoder"})
    reference: Path | None = field(
        default=None, metadata={"help": "recorded sequence the agent sends: gives PSNR and ground truth"}
    )
    camera: CameraSettings = field(
        default=CameraSettings(), metadata={"help": "camera of the reference, where it does not say it"}
    )
    bundle: Literal["process", "inline"] = field(
        default="process", metadata={"help": "bundle adjustment in a process of its own, or between frames"}
    )
    checkpoint_interval_s: float = field(
        default=4.0, metadata={"help": "seconds between checkpoints of the map in the output folder"}
    )
    resume: bool = field(
        default=True, metadata={"help": "go on with the map in the output folder if it is of the same stream"}
    )
    record: Path | None = field(
        default=None, metadata={"help": "also keep everything that is sent in this recording (MCAP)"}
    )
    save_images: SavedImages = field(
        default="none", metadata={"help": "decoded images kept in the output folder, for exports"}
    )
    dense_cloud: DenseWhen = field(
        default="auto",
        metadata={
            "help": "depth of keyframes, for dense.ply and the viewer: live, at the end of the stream, auto "
            "(live on four cores or more) or none"
        },
    )
    keep_running: bool = field(
        default=False, metadata={"help": "wait for the next agent after the source's last frame"}
    )
    idle_timeout_s: float | None = field(
        default=None, metadata={"help": "end when nothing arrived for so many seconds after the first frame"}
    )
    duration_s: float | None = field(default=None, metadata={"help": "end after so many seconds"})
    marker: MarkerSettings = field(default=MarkerSettings(), metadata={"help": "marker that tells the metre"})
    reconstruction: ReconstructionSettings = field(
        default=ReconstructionSettings(), metadata={"help": "tracking and mapping"}
    )
    view: ViewSettings = field(default=ViewSettings(), metadata={"help": "viewer"})

    @property
    def dense_at_end(self) -> bool:
        """Whether depth waits for the end of the stream; a replay has nothing to show before."""
        too_few = self.mode == "replay" or usable_cores() < _CORES_FOR_LIVE_DEPTH
        return self.dense_cloud == "end" or (self.dense_cloud == "auto" and too_few)

    def warn(self) -> None:
        """Say which values do nothing beside the others."""
        if idle := self.view.without_effect():
            logger.warning("%s: no effect with view %s", ", ".join(idle), self.view.view)
        if self.out is None and self.checkpoint_interval_s != ServerSettings.checkpoint_interval_s:
            logger.warning("checkpoint_interval_s: no effect without out, a folder for checkpoints")
        if self.mode == "replay" and self.max_age_ms != ServerSettings.max_age_ms:
            logger.warning("max_age_ms: no effect in mode replay, where no frame is dropped for its age")
        if self.keep_running and self.idle_timeout_s is not None:
            logger.warning("idle_timeout_s: no effect with keep_running, which waits for the next agent")

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: A value is out of range.
        """
        check_agent_id(self.agent_id)
        check_threads(self.threads)
        self.camera.check_has(self.reference)
        if not 0.1 <= self.checkpoint_interval_s <= 3600:
            raise ValueError(
                f"checkpoint_interval_s must be in [0.1, 3600], got {self.checkpoint_interval_s}"
            )
        for name in ("idle_timeout_s", "duration_s", "max_age_ms"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")
        check_save_images(self.save_images, self.out)
