"""Settings of the agent process."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from semcast.agent.source_settings import SourceSettings
from semcast.channel.trace import SNR_RANGE_DB
from semcast.common.codec import DEFAULT_CODEC, MODULATION_HELP, PRECISION_HELP, Device, Modulation, Precision
from semcast.common.codecs import Runtime
from semcast.common.cores import check_threads
from semcast.common.keys import DEFAULT_AGENT_ID, check_agent_id
from semcast.common.network_settings import NetworkSettings
from semcast.common.rate import NATIVE_RATE, RateChoice


@dataclass(frozen=True, kw_only=True)
class AgentSettings:
    """The agent process: what it sends, encoded how, and to whom.

    Raises:
        ValueError: A value is out of range, or values contradict each other.
    """

    agent_id: str = field(default=DEFAULT_AGENT_ID, metadata={"help": "name of this agent"})
    mode: Literal["live", "replay"] = field(
        default="live",
        metadata={"help": "live: newest frame wins; replay: every frame, in order, when the server takes it"},
    )
    source: SourceSettings = field(metadata={"help": "where frames come from"})
    codec: str = field(default=DEFAULT_CODEC, metadata={"help": "codec by name or file of weights"})
    modulation: Modulation = field(default="16qam", metadata={"help": MODULATION_HELP})
    weights: Path | None = field(default=None, metadata={"help": "weights instead of the shipped ones"})
    threads: int = field(default=1, metadata={"help": "CPU threads of the encoder"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    device: Device = field(default="auto", metadata={"help": "device of the encoder"})
    runtime: Runtime = field(
        default="auto",
        metadata={"help": "what computes a learned encoder: torch, onnx, or auto (torch where it is there)"},
    )
    snr_db: float = field(
        default=10.0,
        metadata={
            "flag": "expect_snr_db",
            "help": "SNR in dB to encode for: in replay always, in live until the server reports the link's",
        },
    )
    rate: RateChoice = field(
        default=NATIVE_RATE,
        metadata={
            "help": "channel uses per pixel value; auto: fewer on a good link and more on a bad one, as the "
            "server reports it"
        },
    )
    share_source: Literal["off", "jpeg", "png"] = field(
        default="off",
        metadata={
            "help": "also publish the original frames, not through the channel, so that a recording keeps "
            "them: jpeg (quality 95) or png (lossless)"
        },
    )
    follow_server: bool = field(
        default=True,
        metadata={
            "help": "live: send only one frame in 2, 3, ... while the server can't keep up with every one; "
            "begins at about 12 a second"
        },
    )
    wait: bool = field(
        default=True,
        metadata={
            "help": "wait for channel and server before the first frame; live: encode none while nobody "
            "takes them"
        },
    )
    network: NetworkSettings = field(default=NetworkSettings(), metadata={"help": "where the hub is"})

    def __post_init__(self) -> None:
        check_agent_id(self.agent_id)
        if self.mode == "live" and self.source.pace == "receiver":
            raise ValueError("pace 'receiver' needs mode 'replay', got mode 'live'")
        if self.mode == "replay" and self.rate == "auto":
            raise ValueError(
                "rate 'auto' needs mode 'live', got mode 'replay': frames are not to depend on timing"
            )
        check_threads(self.threads)
        low, high = SNR_RANGE_DB
        if not low <= self.snr_db <= high:
            raise ValueError(f"snr_db must be in [{low:g}, {high:g}], got {self.snr_db:g}")
