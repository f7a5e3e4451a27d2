"""One link: what a frame's slots look like at the receiver. Pure and seeded, without network or clock."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.channel.awgn import complex_noise
from semcast.channel.power import normalise_power
from semcast.channel.registry import ChannelModel, build_channel
from semcast.channel.settings import ChannelSettings
from semcast.channel.slot_time import SlotTime
from semcast.common.codec import EncodedImage, ReceivedImage
from semcast.common.phy.equaliser import ChannelKnowledge, Equalised, equalise
from semcast.common.phy.pilots import insert_pilots
from semcast.common.shapes import check_shape

_FRAME_STREAM = 0xF4A3E


@dataclass(frozen=True)
class Transmission:
    """One frame at the receiver's antenna.

    Attributes:
        slots_rx: ``(num_slots, uses_per_slot)`` complex64, zero in lost slots.
        slot_lost: ``(num_slots,)`` bool, slots that never arrived. The receiver knows which ones.
        frame_lost: True when nothing of the frame arrived; ``slots_rx`` is zero then.
        snr_db_set: SNR set for this frame. For logs and plots: the receiver must not use it.
        truth: True gains and noise, for perfect-CSI curves only.
    """

    slots_rx: NDArray[np.complex64]
    slot_lost: NDArray[np.bool_]
    frame_lost: bool
    snr_db_set: float
    truth: ChannelKnowledge

    def equalise(self, encoded: EncodedImage, *, perfect_csi: bool = False) -> Equalised:
        """Do what a receiver does: estimate the channel, MMSE.

        Args:
            encoded: What was sent; only what its header tells is used.
            perfect_csi: Hand the true channel to the equaliser instead of the pilots' estimate.
        """
        return equalise(
            self.slots_rx,
            encoded.shape_hw,
            encoded.modulation,
            slot_lost=self.slot_lost,
            knowledge=self.truth if perfect_csi else None,
            levels=encoded.levels,
            allocation=encoded.allocation,
        )


class Link:
    """A channel with its settings, which may change between frames.

    The randomness of a frame comes from the seed and the frame number alone, the time from ``t_s``. Fading
    starts at the first frame transmitted, an SNR trace at the first one it is in force for.
    """

    def __init__(self, settings: ChannelSettings, seed: int = 0) -> None:
        """Build the channel.

        Raises:
            ConfigError: See ``build_channel``.
            ValueError: The seed is negative.
        """
        if seed < 0:
            raise ValueError(f"seed must be at least 0, got {seed}")
        self._settings = settings
        self._seed = seed
        self._model = build_channel(settings, seed)
        self._start_s: float | None = None
        self._trace_start_s: float | None = None
        self._slot_time = SlotTime()
        self._next_frame = 0

    @property
    def settings(self) -> ChannelSettings:
        """The settings in force."""
        return self._settings

    @property
    def start_snr_db(self) -> float:
        """SNR in dB that is set for the first frame, also where a trace sets it."""
        return self._model.snr_db(0.0)

    def switch(self, settings: ChannelSettings, model: ChannelModel) -> None:
        """Change to settings, from the next frame on, and the channel that was built of them.

        That is built before, as reading a trace may take long, or fail.
        A trace that is another one than before begins with the next frame.
        """
        if settings.trace_in_force() != self._settings.trace_in_force():
            self._trace_start_s = None
        self._settings, self._model = settings, model

    def restart(self) -> None:
        """Let time begin anew with the next frame, and with it fading and SNR traces."""
        self._start_s = self._trace_start_s = None
        self._slot_time.restart()
        self._next_frame = 0

    def transmit(self, slots: NDArray[np.complex64], t_s: float, frame_id: int | None = None) -> Transmission:
        """Send one frame through the channel.

        The frame is scaled to unit average power first, pilots included, so that ``snr_db`` means the same
        for every codec; the receiver sees that scale as part of the channel gain.

        Args:
            slots: ``(num_slots, uses_per_slot)`` transmitted samples, pilots included.
            t_s: Capture time in seconds on any clock that doesn't run backwards.
            frame_id: Number of the frame, at least 0; None counts frames from 0.

        Raises:
            ValueError: The samples are not two-dimensional, not finite or all zero.
        """
        check_shape(slots, "S U", "slots")
        if frame_id is None:
            frame_id = self._next_frame
        if frame_id < 0:
            raise ValueError(f"frame_id must be at least 0, got {frame_id}")
        self._next_frame = frame_id + 1
        if self._start_s is None:
            self._start_s = t_s
        if self._trace_start_s is None:
            self._trace_start_s = t_s
        start_s = self._trace_start_s if self._settings.channel == "trace" else self._start_s
        if self._settings.fades_over_time:
            self._slot_time.check(slots.shape[0], self._settings.slot_ms, t_s)
        sent, power = normalise_power(slots)
        rng = np.random.default_rng((self._seed, _FRAME_STREAM, frame_id))
        frame_lost = bool(rng.random() < self._settings.frame_loss)
        draw = self._model.draw(slots.shape[0], t_s - start_s, rng)
        truth = ChannelKnowledge(h=draw.h / np.float32(np.sqrt(power)), noise_var=draw.noise_var)
        lost = np.ones_like(draw.lost) if frame_lost else draw.lost
        if frame_lost:
            slots_rx = np.zeros(slots.shape, dtype=np.complex64)
        else:
            slots_rx = complex_noise(slots.shape, draw.noise_var[:, None], rng)
            slots_rx += draw.h[:, None] * sent
            slots_rx[lost] = 0
        return Transmission(
            slots_rx=slots_rx,
            slot_lost=lost,
            frame_lost=frame_lost,
            snr_db_set=draw.snr_db,
            truth=truth,
        )

    def receive(
        self,
        encoded: EncodedImage,
        t_s: float,
        frame_id: int | None = None,
        *,
        perfect_csi: bool = False,
    ) -> Equalised | None:
        """Send one encoded image and equalise it: pilots in, channel, estimation, MMSE.

        Args:
            encoded: What a codec made.
            t_s: See ``transmit``.
            frame_id: See ``transmit``.
            perfect_csi: See ``Transmission.equalise``.

        Returns:
            Symbols for the decoder and the receiver's own SNR estimate; None when the frame is lost.
        """
        sent = self.transmit(insert_pilots(encoded.symbols), t_s, frame_id)
        return None if sent.frame_lost else sent.equalise(encoded, perfect_csi=perfect_csi)

    def carry(
        self,
        encoded: EncodedImage,
        t_s: float,
        frame_id: int | None = None,
        *,
        perfect_csi: bool = False,
    ) -> ReceivedImage | None:
        """Return what the codec decodes of ``receive``, or None when the frame is lost."""
        equalised = self.receive(encoded, t_s, frame_id, perfect_csi=perfect_csi)
        return None if equalised is None else equalised.received
