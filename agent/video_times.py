"""When the frames of a video were taken, as its container says, and whether all of them could be read."""

import math

#: Stamps of a constant frame rate are off by the rounding of their container: Matroska's to whole ms,
#: and that of the first frame comes on top.
_STAMP_ROUNDING_NS = 1_000_000


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

    def next_ns(self, stamp_ms: float) -> int:
        """Return when the next frame was taken, in ns since the first one.

        Args:
            stamp_ms: What its container says, on a clock of its own; where that is no number, or does not
                go on, the frame is a usual period after the one before.
        """
        stamp_ns = round(stamp_ms * 1e6) if math.isfinite(stamp_ms) else 0
        if self.num_frames == 0:
            self._began_ns = stamp_ns
        nominal_ns = round(self.num_frames * 1e9 / self._rate_hz)
        stamp_ns -= self._began_ns
        if abs(stamp_ns - nominal_ns) <= _STAMP_ROUNDING_NS:
            self._ahead_ns = 0
        elif stamp_ns > self.last_ns:
            self._ahead_ns = stamp_ns - nominal_ns
        self.last_ns = max(self.last_ns + 1, nominal_ns + self._ahead_ns)
        self.num_frames += 1
        return self.last_ns

    def is_cut(self, num_stored: int) -> bool:
        """Tell whether the pass ended well before the number of frames that the container says it has.

        Containers count frames roughly. Phones trim by an edit list that hides frames, which are counted all
        the same. Matroska counts none: OpenCV makes a number of duration and usual rate, which a varying rate
        need not reach before its end.
        """
        reached = max(self.num_frames, self.last_ns * 1e-9 * self._rate_hz + 1)
        return reached < min(0.98 * num_stored, num_stored - 3)
