"""When the frames of a video were taken, as its container says, and whether all of them could be read."""

import math

#: Stamps of a constant frame rate are off by the rounding of their container: Matroska's to whole ms,
#: and that of the first frame comes on top.
_STAMP_ROUNDING_NS = 1_000_000
#: A stamp is wrong if it is so many times as far from where it is expected as the one after it, and later.
_WRONG_LEAD = 4


class VideoTimes:
    """Times of the frames of one pass through a video, one after the other.

    Phones and screen recorders vary their frame rate: the file's own stamps count, where they go on.

    Args:
        rate_hz: Usual frames a second.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._began_ns = self._ahead_ns = 0
        #: Of the last frame, since the first one; -1 before that.
        self.last_ns = -1
        self.num_frames = 0

    def next_ns(self, stamp_ms: float, following_ms: float = math.nan) -> int:
        """Return when the next frame was taken, in ns since the first one.

        Args:
            stamp_ms: What its container says, on a clock of its own; where that is no number, or does not
                go on, the frame is a usual period after the one before.
            following_ms: The same of the frame after it; no number where there is none. Where it goes on from
                the frame before, and this one is far ahead of both, this one has a wrong stamp.
        """
        if self.num_frames == 0 and math.isfinite(stamp_ms):
            self._began_ns = round(stamp_ms * 1e6)
        stamp_ns, following_ns = self._since_begun_ns(stamp_ms), self._since_begun_ns(following_ms)
        nominal_ns, nominal_following_ns = (
            round((self.num_frames + k) * 1e9 / self._rate_hz) for k in (0, 1)
        )
        lead_ns = stamp_ns - nominal_ns - self._ahead_ns
        off_ns = abs(following_ns - nominal_following_ns - self._ahead_ns)
        is_wrong = self.last_ns < following_ns < stamp_ns and lead_ns > _WRONG_LEAD * off_ns
        if stamp_ns > self.last_ns and not is_wrong:
            is_regular = abs(stamp_ns - nominal_ns) <= _STAMP_ROUNDING_NS and nominal_ns > self.last_ns
            self._ahead_ns = 0 if is_regular else stamp_ns - nominal_ns
        self.last_ns = max(self.last_ns + 1, nominal_ns + self._ahead_ns)
        self.num_frames += 1
        return self.last_ns

    def _since_begun_ns(self, stamp_ms: float) -> int:
        """Return a stamp as time since the first one, -1 where it is no number."""
        return round(stamp_ms * 1e6) - self._began_ns if math.isfinite(stamp_ms) else -1

    def is_cut(self, num_stored: int) -> bool:
        """Tell whether the pass ended well before the number of frames that the container says it has.

        Containers count frames roughly. Phones trim by an edit list that hides frames, which are counted all
        the same. Matroska counts none: OpenCV makes a number of duration and usual rate, which a varying rate
        need not reach before its end.
        """
        reached = max(self.num_frames, self.last_ns * 1e-9 * self._rate_hz + 1)
        return reached < min(0.98 * num_stored, num_stored - 3)
