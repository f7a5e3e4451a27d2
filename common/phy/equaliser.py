"""Receiver front end: channel and noise estimation from pilots, MMSE equalisation, effective SNR per slot.

The model of slot s is ``y = h_s * x + n`` with one complex gain and one noise variance for the whole slot.
Nothing but the received samples is used, unless perfect channel knowledge is passed in explicitly.

A least-squares gain from P pilots has an error of variance ``noise_var / P``, which reaches the decoder as
additional noise: the effective SNR is therefore ``|h|^2 / (noise_var * (1 + 1 / P))``, and the MMSE estimate
is shrunk by exactly ``snr / (1 + snr)`` of that SNR.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import LOST_SLOT_SNR_DB, Modulation, ReceivedImage
from semcast.common.levels import ALL_LEVELS, Levels
from semcast.common.phy.pilots import pilot_symbols, split
from semcast.common.phy.slots import SlotLayout, layout_for
from semcast.common.shapes import check_shape

#: Assumed where one single pilot is all that was sent (one block in the whole frame).
NOMINAL_SNR_DB = 10.0
#: A slot whose noise differs from the pooled noise by more standard deviations than this keeps its own.
OUTLIER_SIGMAS = 3.7
_POOLING_ROUNDS = 12
#: Estimates of so few degrees of freedom scatter by as much as bursts raise them: none of them says much.
_FEW_DOF = 2


@dataclass(frozen=True)
class ChannelKnowledge:
    """True channel of each slot, for the perfect-CSI curves only.

    Attributes:
        h: ``(num_slots,)`` complex64 gains, transmit power scaling included.
        noise_var: ``(num_slots,)`` float32 complex noise variances.
    """

    h: NDArray[np.complex64]
    noise_var: NDArray[np.float32]


@dataclass(frozen=True)
class ChannelEstimate:
    """What the receiver believes about the channel of one frame.

    Attributes:
        h: ``(num_slots,)`` complex64 gain of each slot, 0 where nothing arrived.
        noise_var: ``(num_slots,)`` float32 noise variance of each slot.
        noise_floor: Noise variance shared by all slots without a burst.
        num_pilots: Pilots behind each gain; 0 when the channel is known and not estimated.
        arrived: ``(num_slots,)`` bool.
    """

    h: NDArray[np.complex64]
    noise_var: NDArray[np.float32]
    noise_floor: float
    num_pilots: int
    arrived: NDArray[np.bool_]

    @property
    def effective_noise_var(self) -> NDArray[np.float32]:
        """``(num_slots,)`` noise variance including the error of the estimated gain."""
        error = 1.0 / self.num_pilots if self.num_pilots else 0.0
        return self.noise_var * np.float32(1.0 + error)

    @property
    def snr_db(self) -> float:
        """Mean received power of the slots that arrived over the noise floor, in dB: the link's own SNR.

        Noisy slots count for less. Bursts are no floor as long as they leave a slot alone, or with fewer than
        four pilots a slot most of them; where all are hit, what the bursts leave is the link's SNR. The part
        of ``|h|^2`` that is estimation error is taken off.
        """
        if not self.arrived.any() or self.noise_floor <= 0.0:
            return LOST_SLOT_SNR_DB
        noise_var = self.noise_var[self.arrived].astype(np.float64)
        power = np.square(np.abs(self.h[self.arrived]).astype(np.float64))
        if self.num_pilots:
            power -= noise_var / self.num_pilots
        return _to_db(float(np.average(power, weights=1.0 / noise_var)) / self.noise_floor)


@dataclass(frozen=True)
class Equalised:
    """One frame behind the equaliser.

    Attributes:
        received: What the codec decodes.
        snr_db: The receiver's estimate of the link SNR, for feedback to the agent; at least
            ``LOST_SLOT_SNR_DB``, which also stands for "nothing arrived".
        channel: The estimate behind both.
    """

    received: ReceivedImage
    snr_db: float
    channel: ChannelEstimate


def _to_db(ratio: float) -> float:
    return max(LOST_SLOT_SNR_DB, 10.0 * float(np.log10(max(ratio, 1e-12))))


def _pool_noise(per_slot: NDArray[np.float64], dof: int) -> tuple[NDArray[np.float64], float]:
    """Replace the noise estimates of all slots that agree by their mean.

    Each estimate is ``noise_var * Gamma(dof) / dof``. The Wilson-Hilferty cube root makes it normal, so one
    threshold serves few pilots and many. The search starts at the smallest estimate, or the lower quartile
    where single ones say little: bursts only raise noise, so the quiet slots are the floor even when nearly
    all slots are hit.

    Args:
        per_slot: ``(S,)`` unbiased estimates, S >= 1.
        dof: Complex degrees of freedom behind each.

    Returns:
        ``(S,)`` variances and the pooled one.
    """
    centre, spread = 1.0 - 1.0 / (9.0 * dof), float(np.sqrt(1.0 / (9.0 * dof)))
    rising = np.sort(per_slot[per_slot > 0.0])
    if not rising.size:
        return per_slot, 0.0
    rank = 0 if dof > _FEW_DOF else (rising.size - 1) // 4
    # Where a value of this rank is expected (Blom 1958).
    sigmas = NormalDist().inv_cdf((rank + 0.625) / (rising.size + 0.25))
    floor = float(rising[rank]) / max(centre + sigmas * spread, 0.1) ** 3
    agrees = np.ones(per_slot.size, dtype=bool)
    for _ in range(_POOLING_ROUNDS):
        deviation = (np.cbrt(per_slot / floor) - centre) / spread
        close = np.abs(deviation) < OUTLIER_SIGMAS
        if not close.any():
            break
        is_same = np.array_equal(close, agrees)
        agrees, floor = close, float(per_slot[close].mean())
        if is_same:
            break
    return np.where(agrees, floor, per_slot), floor


def estimate_channel(
    pilots_rx: NDArray[np.complex64], slot_lost: NDArray[np.bool_] | None = None
) -> ChannelEstimate:
    """Estimate gain and noise variance of each slot from its pilots.

    The gain is the least-squares one. With two or more pilots a slot, the noise is what the gain doesn't
    explain, divided by P - 1 (unbiased), and pooled over all slots whose estimates agree; a slot hit by a
    burst keeps its own. With one pilot a slot that residual is always zero: there the noise is half the mean
    squared difference of neighbouring gains, exact on a constant channel and pessimistic on a fading one.

    Args:
        pilots_rx: ``(num_slots, P)`` received pilots.
        slot_lost: ``(num_slots,)`` slots known not to have arrived. A slot that holds only zeros or any
            non-finite sample counts as lost as well.
    """
    num_slots, num_pilots = pilots_rx.shape
    known = pilot_symbols(SlotLayout(num_slots=num_slots, blocks_per_slot=num_pilots))
    arrived = np.isfinite(pilots_rx).all(axis=1) & (pilots_rx != 0).any(axis=1)
    if slot_lost is not None:
        arrived &= ~slot_lost
    h = np.zeros(num_slots, dtype=np.complex64)
    noise_var = np.ones(num_slots, dtype=np.float32)
    if not arrived.any():
        return ChannelEstimate(
            h=h, noise_var=noise_var, noise_floor=1.0, num_pilots=num_pilots, arrived=arrived
        )
    y, p = pilots_rx[arrived].astype(np.complex128), known[arrived].astype(np.complex128)
    h_ls = (np.conj(p) * y).mean(axis=1)
    if num_pilots > 1:
        residual = np.square(np.abs(y - h_ls[:, None] * p)).sum(axis=1) / (num_pilots - 1)
        variance, floor = _pool_noise(residual, num_pilots - 1)
    elif h_ls.size > 1:
        floor = 0.5 * float(np.mean(np.square(np.abs(np.diff(h_ls)))))
        variance = np.full(h_ls.size, floor)
    else:
        floor = float(np.square(np.abs(h_ls[0]))) / (1.0 + 10.0 ** (NOMINAL_SNR_DB / 10.0))
        variance = np.full(1, floor)
    # A noiseless link would give 0 and an infinite SNR.
    smallest = 1e-9 * max(float(np.mean(np.square(np.abs(h_ls)))), 1e-20)
    h[arrived] = h_ls
    noise_var[arrived] = np.maximum(variance, smallest)
    return ChannelEstimate(
        h=h,
        noise_var=noise_var,
        noise_floor=max(floor, smallest),
        num_pilots=num_pilots,
        arrived=arrived,
    )


def _known_channel(knowledge: ChannelKnowledge, lost: NDArray[np.bool_]) -> ChannelEstimate:
    """The true channel in place of an estimate."""
    arrived = np.logical_not(lost)
    floor = float(np.median(knowledge.noise_var[arrived])) if arrived.any() else 1.0
    return ChannelEstimate(
        h=np.where(arrived, knowledge.h, np.complex64(0)),
        noise_var=knowledge.noise_var,
        noise_floor=floor,
        num_pilots=0,
        arrived=arrived,
    )


def equalise(
    slots_rx: NDArray[np.complex64],
    shape_hw: tuple[int, int],
    modulation: Modulation,
    *,
    slot_lost: NDArray[np.bool_] | None = None,
    knowledge: ChannelKnowledge | None = None,
    levels: Levels = ALL_LEVELS,
    allocation: bytes = b"",
) -> Equalised:
    """Turn the received slots of one frame into data symbols and their reliability.

    Args:
        slots_rx: ``(num_slots, uses_per_slot)`` received samples, pilots first.
        shape_hw: Image size in pixels, which fixes the slot grid.
        modulation: Passed on to the decoder.
        slot_lost: ``(num_slots,)`` slots known not to have arrived; their symbols become zero.
        knowledge: True channel, for perfect-CSI curves; None estimates it.
        levels: Passed on to the decoder.
        allocation: Passed on to the decoder.

    Raises:
        ValueError: An array doesn't have the size that ``shape_hw`` demands.
    """
    layout = layout_for(shape_hw)
    check_shape(slots_rx, f"{layout.num_slots} {layout.uses_per_slot}", "slots_rx")
    if slot_lost is not None:
        check_shape(slot_lost, f"{layout.num_slots}", "slot_lost")
    pilots_rx, data_rx = split(slots_rx)
    lost = np.asarray(~np.isfinite(data_rx).all(axis=1), dtype=np.bool_)
    if slot_lost is not None:
        lost |= slot_lost
    if knowledge is None:
        channel = estimate_channel(pilots_rx, lost)
    else:
        check_shape(knowledge.h, f"{layout.num_slots}", "knowledge.h")
        check_shape(knowledge.noise_var, f"{layout.num_slots}", "knowledge.noise_var")
        channel = _known_channel(knowledge, lost)
    noise_var = channel.effective_noise_var
    power = np.square(np.abs(channel.h))
    gain = np.where(channel.arrived, np.conj(channel.h) / (power + noise_var), 0).astype(np.complex64)
    symbols = np.zeros(data_rx.shape, dtype=np.complex64)
    np.multiply(data_rx, gain[:, None], out=symbols, where=channel.arrived[:, None])
    floor_ratio = 10.0 ** (LOST_SLOT_SNR_DB / 10.0)
    ratio = np.where(channel.arrived, power / noise_var, 0.0)
    effective_snr_db = np.maximum(
        10.0 * np.log10(np.maximum(ratio, floor_ratio)).astype(np.float32), np.float32(LOST_SLOT_SNR_DB)
    )
    received = ReceivedImage(
        shape_hw=shape_hw,
        symbols=symbols,
        effective_snr_db=effective_snr_db,
        modulation=modulation,
        levels=levels,
        allocation=allocation,
    )
    return Equalised(received=received, snr_db=channel.snr_db, channel=channel)
