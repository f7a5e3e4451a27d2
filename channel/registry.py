"""Channel models by name. A model draws, for one frame, what happens to each of its slots.

Models keep no random state: a frame's draw depends on seed, frame number and time alone, so losing a frame
changes nothing about the others. Time counts from the first frame of a link, for an SNR trace from the first
one it is in force for: a restarted channel begins its SNR trace and its Doppler fading anew.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semcast.channel.awgn import noise_variance
from semcast.channel.erasure import gilbert_elliott, independent_losses
from semcast.channel.fading import clarke_gains, rayleigh_gains, rician_gains
from semcast.channel.settings import ChannelSettings
from semcast.channel.trace import ConstantTrace, FileTrace, RandomWalkTrace, SnrTrace, ramp, read_trace_csv
from semcast.common.config import near_match
from semcast.common.errors import ConfigError

_FADING_STREAM = 0xFAD
_SIGHT_STREAM = 0x105


@dataclass(frozen=True)
class SlotDraw:
    """What happens to the slots of one frame.

    Attributes:
        snr_db: SNR set for this moment, before fading, bursts and losses.
        h: ``(num_slots,)`` complex64 gains.
        noise_var: ``(num_slots,)`` float32 complex noise variances.
        lost: ``(num_slots,)`` bool, slots of which nothing arrives.
    """

    snr_db: float
    h: NDArray[np.complex64]
    noise_var: NDArray[np.float32]
    lost: NDArray[np.bool_]


class ChannelModel(Protocol):
    """One kind of channel with its settings; it has no state but those and a seed."""

    def snr_db(self, elapsed_s: float) -> float:
        """Return the SNR in dB that is set so long after the first frame of the trace."""

    def draw(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> SlotDraw:
        """Draw one frame.

        Args:
            num_slots: Slots of the frame.
            elapsed_s: Time since the first frame: of the trace where there is one, else of the link.
            rng: Randomness of this frame alone.
        """


class _Model:
    """AWGN; the other models change parts of its draw."""

    def __init__(self, settings: ChannelSettings, seed: int) -> None:
        self._settings = settings
        self._seed = seed

    def snr_db(self, elapsed_s: float) -> float:
        del elapsed_s
        return self._settings.snr_db

    def _gains(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> NDArray[np.complex64]:
        del elapsed_s, rng
        return np.ones(num_slots, dtype=np.complex64)

    def _noise_raise(self, num_slots: int, rng: np.random.Generator) -> NDArray[np.float32]:
        del rng
        return np.ones(num_slots, dtype=np.float32)

    def _lost(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> NDArray[np.bool_]:
        del elapsed_s, rng
        return np.zeros(num_slots, dtype=bool)

    def draw(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> SlotDraw:
        snr_db = self.snr_db(elapsed_s)
        return SlotDraw(
            snr_db=snr_db,
            h=self._gains(num_slots, elapsed_s, rng),
            noise_var=np.float32(noise_variance(snr_db)) * self._noise_raise(num_slots, rng),
            lost=self._lost(num_slots, elapsed_s, rng),
        )


class _Rayleigh(_Model):
    def _gains(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> NDArray[np.complex64]:
        settings = self._settings
        if settings.doppler_hz <= 0.0:
            return rayleigh_gains(num_slots, rng)
        times_s = elapsed_s + 1e-3 * settings.slot_ms * np.arange(num_slots, dtype=np.float64)
        waves = np.random.default_rng((self._seed, _FADING_STREAM))
        return clarke_gains(times_s, settings.doppler_hz, waves)


class _Rician(_Rayleigh):
    def _gains(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> NDArray[np.complex64]:
        scattered = super()._gains(num_slots, elapsed_s, rng)
        phase_rad = 2.0 * np.pi * np.random.default_rng((self._seed, _SIGHT_STREAM)).random()
        return rician_gains(scattered, self._settings.rician_k_db, phase_rad)


class _Erasure(_Model):
    def _lost(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> NDArray[np.bool_]:
        del elapsed_s
        return independent_losses(num_slots, self._settings.slot_loss, rng)


class _Burst(_Model):
    def _noise_raise(self, num_slots: int, rng: np.random.Generator) -> NDArray[np.float32]:
        settings = self._settings
        hit = gilbert_elliott(num_slots, settings.slot_loss, settings.burst_slots, rng)
        return np.where(hit, 10.0 ** (settings.burst_noise_db / 10.0), 1.0).astype(np.float32)


class _Trace(_Model):
    def __init__(self, settings: ChannelSettings, seed: int) -> None:
        super().__init__(settings, seed)
        self._trace = self._build(settings)

    def _build(self, settings: ChannelSettings) -> SnrTrace:
        if settings.trace == "ramp":
            return ramp(settings.snr_db, settings.trace_end_db, settings.trace_s)
        if settings.trace == "walk":
            return RandomWalkTrace(settings.snr_db, settings.trace_step_db, self._seed)
        if settings.trace == "file" and settings.trace_file is not None:
            return read_trace_csv(settings.trace_file)
        return ConstantTrace(settings.snr_db)

    def snr_db(self, elapsed_s: float) -> float:
        return self._trace.snr_db(elapsed_s)

    def _lost(self, num_slots: int, elapsed_s: float, rng: np.random.Generator) -> NDArray[np.bool_]:
        share = self._trace.slot_loss(elapsed_s) if isinstance(self._trace, FileTrace) else 0.0
        # Without losses nothing is drawn: the noise is the same as with a file that has no such column.
        if share <= 0.0:
            return super()._lost(num_slots, elapsed_s, rng)
        return independent_losses(num_slots, share, rng)


#: The models by the names that settings have.
MODELS: dict[str, Callable[[ChannelSettings, int], ChannelModel]] = {
    "awgn": _Model,
    "rayleigh": _Rayleigh,
    "rician": _Rician,
    "erasure": _Erasure,
    "burst": _Burst,
    "trace": _Trace,
}


def build_channel(settings: ChannelSettings, seed: int) -> ChannelModel:
    """Build the model that ``settings.channel`` names.

    Raises:
        ConfigError: The name is unknown or a trace can't be read.
    """
    if settings.channel not in MODELS:
        hint = near_match(settings.channel, list(MODELS))
        raise ConfigError(f"channel must be one of {', '.join(MODELS)}, got {settings.channel!r}{hint}")
    return MODELS[settings.channel](settings, seed)
