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

#: Frames the fluctuation of slots is learned from: more follow a changing link later and choose no better.
_MAX_FRAMES = 8
#: A frame so many standard errors off those before it is of a link that has changed.
_JUMP = 4.0
#: Quantile of the normal distribution.
_ONE_IN_TWENTY = 1.645
#: SNR in dB from which on a symbol of so many bits carries all of them, about: what is lost in some slots
#: can't be made up for by others that hold so many bits and no more.
_ENOUGH_DB = {2: 8.0, 4: 15.0, 6: 21.0}


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

    def carried(self, enough_db: float) -> NDArray[np.float64]:
        """Return ``(num_slots,)`` of ``log(1 + snr)``: what slots carry, none more than at ``enough_db``."""
        return np.asarray(np.log1p(np.minimum(self.linear, 10.0 ** (enough_db / 10.0))))

    @property
    def variance_of_estimates(self) -> float:
        """Variance of ``carried`` that comes from estimating each gain."""
        if not self.num_pilots:
            return 0.0
        return float(np.mean(2.0 * self.linear / (self.num_pilots * np.square(1.0 + self.linear))))


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

    That of a steady link that carries as much: by the highest mode of which the slots, none of which counts
    for more than its constellation holds, carry what it needs.

    Args:
        frames: The newest ones, of equally many slots.
    """
    reachable = LOST_SLOT_SNR_DB
    for mode, above in zip(ADAPTIVE_MODES, (*ADAPTIVE_MODES[1:], None), strict=True):
        steady_db = steady_snr_db(frames, _ENOUGH_DB[mode.bits_per_symbol])
        if steady_db >= mode.min_snr_db:
            # Not so far that the next mode, which was not asked yet, would be taken.
            most_db = np.inf if above is None else np.nextafter(above.min_snr_db, -np.inf)
            reachable = float(min(steady_db, most_db))
    return reachable


def steady_snr_db(frames: Sequence[SlotSnrs], enough_db: float) -> float:
    """Return the SNR in dB of a link without fading and losses that carries as much.

    A code that spans all slots has the mean over the slots. One frame of twenty has ``_ONE_IN_TWENTY``
    standard errors less than the mean of the frames before it, not counting what the estimate of each gain
    varies by itself: that much less is counted on, or ``MODE_MARGIN_DB`` less, which the modes keep anyway.
    Slots are taken to differ independently: where bursts or slow fading hit many together, more than one
    frame of twenty has less.

    Args:
        frames: The newest ones, of equally many slots.
        enough_db: Above this SNR a slot carries no more.
    """
    carried = np.concatenate([frame.carried(enough_db) for frame in frames])
    variance = float(np.var(carried)) - float(np.mean([frame.variance_of_estimates for frame in frames]))
    num_slots = len(frames[0].linear)
    error = np.sqrt(max(variance, 0.0) / num_slots * (1.0 + 1.0 / len(frames)))
    mean = float(np.mean(carried))
    counted_on_db = _to_db(float(np.expm1(max(mean - _ONE_IN_TWENTY * error, 0.0))))
    return max(LOST_SLOT_SNR_DB, min(_to_db(float(np.expm1(mean))), counted_on_db + MODE_MARGIN_DB))


def _has_jumped(frames: Sequence[SlotSnrs], newest: SlotSnrs) -> bool:
    """Tell whether the link is another than it was, or cut into other slots."""
    if len(newest.linear) != len(frames[0].linear):
        return True
    enough_db = max(_ENOUGH_DB.values())
    before, now = (np.concatenate([f.carried(enough_db) for f in some]) for some in (frames, [newest]))
    spread = np.sqrt((np.var(before) + np.var(now)) / 2.0)
    error = spread * np.sqrt((1.0 + 1.0 / len(frames)) / len(now))
    return bool(abs(np.mean(now) - np.mean(before)) > _JUMP * error)


def _to_db(ratio: float) -> float:
    return 10.0 * float(np.log10(max(ratio, 1e-12)))
