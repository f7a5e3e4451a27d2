"""What a receiver tells the transmitter about the link, frame by frame.

Learned codecs are told the link's average SNR. A conventional one has to choose what still gets through: it
is told the SNR of a steady link, one without fading and losses, that carries as much.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import LOST_SLOT_SNR_DB
from semcast.common.codecs import is_conventional
from semcast.common.conventional import ADAPTIVE_MODES, MODE_MARGIN_DB
from semcast.common.phy.equaliser import Equalised
from semcast.common.phy.mutual_information import mutual_information, snr_db_that_carries

#: Frames the fluctuation of slots is learned from: more follow a changing link later and choose no better.
_MAX_FRAMES = 8
#: Fewer don't tell a link that has changed from one whose slots fade together.
_MIN_FRAMES = 3
#: A frame this many standard errors off those before it is of a link that has changed.
_JUMP = 4.0
#: Quantiles of the normal distribution.
_ONE_IN_TWENTY = 1.645
_ONE_IN_THOUSAND = 3.09


@dataclass(frozen=True)
class SlotSnrs:
    """SNRs of the slots of a frame.

    Attributes:
        linear: ``(num_slots,)`` effective SNR, 0 where nothing arrived.
        num_pilots: Behind each slot's estimate; 0 where the channel was known.
    """

    linear: NDArray[np.float64]
    num_pilots: int

    @classmethod
    def of(cls, equalised: Equalised) -> "SlotSnrs":
        """Return those of a frame behind the equaliser."""
        snr_db = equalised.received.effective_snr_db
        linear = np.where(snr_db <= LOST_SLOT_SNR_DB, 0.0, 10.0 ** (snr_db.astype(np.float64) / 10.0))
        return cls(linear, equalised.channel.num_pilots)

    def carried(self, bits_per_symbol: int) -> NDArray[np.float64]:
        """Return ``(num_slots,)`` bits that a symbol of so many bits carries in each slot."""
        return mutual_information(bits_per_symbol, self.linear)

    def variance_of_estimates(self, bits_per_symbol: int) -> float:
        """Variance of ``carried`` that comes from estimating each gain."""
        if not self.num_pilots:
            return 0.0
        step = 0.01 * self.linear + 1e-6
        more, less = (mutual_information(bits_per_symbol, self.linear + sign * step) for sign in (1, -1))
        slope = (more - less) / (2.0 * step)
        return float(np.mean(np.square(slope) * 2.0 * self.linear / self.num_pilots))

    def common_error(self, bits_per_symbol: int) -> float:
        """Standard error of the mean of ``carried`` that the noise, estimated once for all slots, brings."""
        arrived = int(np.count_nonzero(self.linear))
        if not self.num_pilots or not arrived:
            return 0.0
        factor = 1.0 + 1.0 / np.sqrt(arrived * max(self.num_pilots - 1, 1))
        more, less = (
            mutual_information(bits_per_symbol, snr) for snr in (self.linear * factor, self.linear / factor)
        )
        return float(np.mean(more - less)) / 2.0


class LinkReporter:
    """Makes the reports of one stream.

    Args:
        codec: Its name.
    """

    def __init__(self, codec: str) -> None:
        self._frames: deque[SlotSnrs] | None = deque(maxlen=_MAX_FRAMES) if is_conventional(codec) else None

    def snr_db(self, equalised: Equalised) -> float:
        """Return the SNR in dB to report on a frame, the next one of the stream."""
        if self._frames is None:
            return equalised.snr_db
        newest = SlotSnrs.of(equalised)
        if self._frames and _has_jumped(self._frames, newest):
            self._frames.clear()
        self._frames.append(newest)
        return reachable_snr_db(self._frames)


def reachable_snr_db(frames: Sequence[SlotSnrs]) -> float:
    """Return the SNR in dB by which an adaptive transmitter chooses a mode that gets through the link.

    That of a steady link that carries as much: by the highest mode whose constellation carries on these slots
    what the mode needs.

    Args:
        frames: The newest ones, of equally many slots.
    """
    reachable = LOST_SLOT_SNR_DB
    constellations = {mode.bits_per_symbol for mode in ADAPTIVE_MODES}
    steady = {bits_per_symbol: steady_snr_db(frames, bits_per_symbol) for bits_per_symbol in constellations}
    for mode, above in zip(ADAPTIVE_MODES, (*ADAPTIVE_MODES[1:], None), strict=True):
        steady_db = steady[mode.bits_per_symbol]
        if steady_db >= mode.min_snr_db:
            # Not so far that the next mode, which was not asked yet, would be taken.
            most_db = np.inf if above is None else np.nextafter(above.min_snr_db, -np.inf)
            reachable = float(min(steady_db, most_db))
    return reachable


def steady_snr_db(frames: Sequence[SlotSnrs], bits_per_symbol: int) -> float:
    """Return the SNR in dB of a link without fading and losses that carries as much.

    A code that spans all slots has the mean over the slots of the mutual information of its constellation
    (mutual-information effective SNR mapping, Brueninghaus et al. 2005). One frame of twenty has
    ``_ONE_IN_TWENTY`` standard errors less than what is expected of it, not counting what the estimate of
    each gain varies by itself: that much less is counted on, or ``MODE_MARGIN_DB`` less, which the modes keep
    anyway. Of slots that differ independently the spread over all of them tells how far frames do. Bursts and
    fading that hit the slots of a frame together show in how far frames differ; where that is little from one
    to the next, the newest is expected again instead of their mean. With too few frames to tell, with a
    change of the link between two frames, or where fading is far from normal, more than one of twenty has
    less.

    Args:
        frames: The newest ones, of equally many slots.
        bits_per_symbol: Of the constellation.
    """
    carried = np.array([frame.carried(bits_per_symbol) for frame in frames])
    known = float(np.mean([frame.variance_of_estimates(bits_per_symbol) for frame in frames]))
    independent = max(float(np.var(carried)) - known, 0.0) / carried.shape[1]
    common = frames[-1].common_error(bits_per_symbol) ** 2
    variance = _variance_of_frames(carried, independent, common)
    expected = float(np.mean(carried))
    squared_error = variance * (1.0 + 1.0 / len(frames))
    if variance > independent:
        means = carried.mean(axis=1)
        squared_step = float(np.mean(np.square(np.diff(means))))
        if squared_step < squared_error:
            expected, squared_error = float(means[-1]), squared_step
    counted_on_db = snr_db_that_carries(bits_per_symbol, expected - _ONE_IN_TWENTY * np.sqrt(squared_error))
    return min(snr_db_that_carries(bits_per_symbol, expected), counted_on_db + MODE_MARGIN_DB)


def _variance_of_frames(carried: NDArray[np.float64], independent: float, common: float) -> float:
    """Return the variance of what frames carry in the mean over their slots.

    Args:
        carried: ``(num_frames, num_slots)`` bits.
        independent: Variance of the mean of slots that differ independently. It is learned from many more
            values than how frames differ, so it stands unless chance explains less than that.
        common: Variance of a frame's mean by the error of its noise estimate.
    """
    dof = len(carried) - 1
    if dof < 1:
        return independent
    between = float(np.var(carried.mean(axis=1), ddof=1))
    # Chi-square over its degrees of freedom, by Wilson and Hilferty.
    by_chance = (1.0 - 2.0 / (9.0 * dof) + _ONE_IN_THOUSAND * np.sqrt(2.0 / (9.0 * dof))) ** 3
    return between if between > by_chance * (independent + common) else independent


def _has_jumped(frames: Sequence[SlotSnrs], newest: SlotSnrs) -> bool:
    """Tell whether the link is another than it was, or cut into other slots."""
    if len(newest.linear) != len(frames[0].linear):
        return True
    if len(frames) < _MIN_FRAMES:
        return False
    finest = ADAPTIVE_MODES[-1].bits_per_symbol
    before, now = np.array([frame.carried(finest) for frame in frames]), newest.carried(finest)
    common = newest.common_error(finest) ** 2
    variance = _variance_of_frames(before, (np.var(before) + np.var(now)) / 2.0 / len(now), common) + common
    error = np.sqrt(variance * (1.0 + 1.0 / len(frames)))
    return bool(abs(np.mean(now) - np.mean(before)) > _JUMP * error)
