"""What can be set about a channel, in one flat set of values that may change while it runs."""

from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal, get_args

from semcast.channel.erasure import least_burst
from semcast.channel.trace import SNR_RANGE_DB

#: Doppler shift times slot length, in Hz ms, at which a gain that is constant within a slot stands for a real
#: one up to an SNR of 26 dB; at 50 it does up to 18 dB, at 100 up to 12 dB.
MAX_DOPPLER_SLOT = 20.0

ChannelName = Literal["awgn", "rayleigh", "rician", "erasure", "burst", "trace"]
TraceName = Literal["constant", "ramp", "walk", "file"]


#: Channels that a value belongs to; the others belong to all.
_CHANNELS_OF: dict[str, tuple[ChannelName, ...]] = {
    "slot_ms": ("rayleigh", "rician"),
    "slot_loss": ("erasure", "burst"),
    "burst_slots": ("burst",),
    "burst_noise_db": ("burst",),
    "rician_k_db": ("rician",),
    "doppler_hz": ("rayleigh", "rician"),
    "trace": ("trace",),
    "trace_end_db": ("trace",),
    "trace_s": ("trace",),
    "trace_step_db": ("trace",),
    "trace_file": ("trace",),
}


#: Kinds of traces that a value belongs to.
_TRACES_OF: dict[str, tuple[TraceName, ...]] = {
    "snr_db": ("constant", "ramp", "walk"),
    "trace_end_db": ("ramp",),
    "trace_s": ("ramp",),
    "trace_step_db": ("walk",),
    "trace_file": ("file",),
}


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must be in [{low:g}, {high:g}], got {value:g}")


@dataclass(frozen=True, kw_only=True)
class ChannelSettings:
    """Settings of the channel between agent and server.

    Raises:
        ValueError: A value is out of range, or values contradict each other.
    """

    channel: ChannelName = field(
        default="awgn",
        metadata={
            "help": "awgn; rayleigh, rician: one random gain per slot; erasure: slots lost one by one; "
            "burst: noise raised for several slots in a row; trace: SNR changes over time"
        },
    )
    snr_db: float = field(default=10.0, metadata={"help": "mean Es/N0 per complex symbol in dB"})
    slot_loss: float = field(
        default=0.2, metadata={"help": "share of slots lost (erasure) or hit by a burst (burst)"}
    )
    frame_loss: float = field(default=0.0, metadata={"help": "share of whole frames lost, on any channel"})
    burst_slots: float = field(
        default=4.0,
        metadata={"help": "mean length of a burst in slots; the end of a frame cuts bursts short"},
    )
    burst_noise_db: float = field(
        default=20.0, metadata={"help": "by how much a burst raises the noise, in dB"}
    )
    rician_k_db: float = field(
        default=6.0, metadata={"help": "power of the line of sight over scattered power, in dB (rician)"}
    )
    doppler_hz: float = field(
        default=0.0,
        metadata={
            "help": "largest Doppler shift in Hz (rayleigh, rician); 0 draws each slot on its own, small "
            "values give one fade for a whole run"
        },
    )
    slot_ms: float = field(default=1.0, metadata={"help": "duration of a slot in ms, for Doppler"})
    trace: TraceName = field(default="ramp", metadata={"help": "shape of the SNR over time (trace)"})
    trace_end_db: float = field(default=2.0, metadata={"help": "SNR at the end of the ramp in dB"})
    trace_s: float = field(default=5.0, metadata={"help": "duration of the ramp in seconds"})
    trace_step_db: float = field(
        default=1.0,
        metadata={"help": "standard deviation in dB of a random walk's steps, one each half second"},
    )
    trace_file: Path | None = field(
        default=None,
        metadata={"help": "CSV file with the columns t_s,snr_db, or t_s,snr_db,slot_loss (trace file)"},
    )
    delay_ms: float = field(default=0.0, metadata={"help": "delay of every frame in ms"})
    jitter_ms: float = field(
        default=0.0,
        metadata={"help": "mean of a random extra delay of each frame in ms; no frame overtakes another"},
    )

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("channel", self.channel, ChannelName),
            ("trace", self.trace, TraceName),
        ):
            words = get_args(allowed)
            if value not in words:
                raise ValueError(f"{name} must be one of {', '.join(words)}, got {value!r}")
        _check_range("snr_db", self.snr_db, *SNR_RANGE_DB)
        _check_range("trace_end_db", self.trace_end_db, *SNR_RANGE_DB)
        _check_range("slot_loss", self.slot_loss, 0.0, 0.99)
        _check_range("frame_loss", self.frame_loss, 0.0, 1.0)
        _check_range("burst_slots", self.burst_slots, 1.0, 1000.0)
        _check_range("burst_noise_db", self.burst_noise_db, 0.0, 60.0)
        _check_range("rician_k_db", self.rician_k_db, -20.0, 40.0)
        _check_range("doppler_hz", self.doppler_hz, 0.0, 2000.0)
        _check_range("slot_ms", self.slot_ms, 0.001, 1000.0)
        _check_range("trace_s", self.trace_s, 0.01, 86400.0)
        _check_range("trace_step_db", self.trace_step_db, 0.0, 10.0)
        _check_range("delay_ms", self.delay_ms, 0.0, 10000.0)
        _check_range("jitter_ms", self.jitter_ms, 0.0, 10000.0)
        least = least_burst(self.slot_loss)
        if self.channel == "burst" and self.burst_slots < least:
            raise ValueError(
                f"burst_slots must be at least {least:g} for a slot_loss of {self.slot_loss:g}, "
                f"got {self.burst_slots:g}"
            )
        if self.channel == "trace" and self.trace == "file" and self.trace_file is None:
            raise ValueError("trace_file must be given for trace 'file', got None")

    @property
    def has_own_snr(self) -> bool:
        """Whether the SNR comes from a file alone."""
        return self.channel == "trace" and self.trace == "file"

    @property
    def snr_label(self) -> str:
        """What stands for the SNR: ``6 dB``, ``ramp from 6 dB`` or ``trace``, that of a file."""
        if self.has_own_snr:
            return "trace"
        return f"{self.trace} from {self.snr_db:g} dB" if self.channel == "trace" else f"{self.snr_db:g} dB"

    @property
    def fades_over_time(self) -> bool:
        """Whether gains depend on when a slot is sent."""
        return self.channel in _CHANNELS_OF["doppler_hz"] and self.doppler_hz > 0.0

    @property
    def fades_within_slots(self) -> bool:
        """Whether a real link would fade within slots, more than one constant gain for each stands for."""
        return self.fades_over_time and self.doppler_hz * self.slot_ms > MAX_DOPPLER_SLOT * (1.0 + 1e-9)

    def trace_in_force(self) -> tuple[object, ...] | None:
        """Return all that decides on the SNR over time, None on channels without a trace."""
        if self.channel != "trace":
            return None
        return (self.trace, *(getattr(self, name) for name in _TRACES_OF if self._matters(name)))

    def without_effect(self, given: Collection[str] | None = None) -> list[str]:
        """Return the names of values that change nothing on this channel.

        Args:
            given: Names of the values that somebody set; None takes those that are not the default.
        """
        return [
            entry.name
            for entry in fields(self)
            if (getattr(self, entry.name) != entry.default if given is None else entry.name in given)
            and not self._matters(entry.name)
        ]

    def _matters(self, name: str) -> bool:
        if self.channel not in _CHANNELS_OF.get(name, (self.channel,)):
            return False
        if name == "slot_ms":
            return self.fades_over_time
        return self.channel != "trace" or self.trace in _TRACES_OF.get(name, (self.trace,))
