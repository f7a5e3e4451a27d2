"""Frames of which a link in an outage let little through, where it usually lets through more.

A second in which most slots are lost does worse than a second without frames: corners of what the decoder
made up become tracks, keyframes and landmarks, and a pose that rests on a few of those is nowhere. So such a
frame is only located, by the tracks of the frames before; with the next that is whole they are followed on
from where they were. An outage that lasts is the link as it is now, and its frames are frames like others.
"""

import numpy as np

from semcast.server.mapping.state import DecodedFrame

#: A frame is in an outage if its share is less than this share of the usual: where one slot in five is lost
#: at random, one frame of fourteen slots in 400 is.
_LEAST_SHARE = 0.55
#: The usual is what the best quarter of the frames of so long has at least. So an outage is taken for one for
#: a second and a half; then a camera in a hand has seen something else, and tracks of before are of no use.
_REMEMBERED_NS, _USUAL_QUANTILE = 2_000_000_000, 0.75
#: And of no more frames than these.
_MOST_FRAMES = 120
#: SNR up to which a slot counts in full: decoded at -5 dB an image is soft, and has a third of its landmarks.
_FULL_SNR = 10.0**-0.5


def share_received(frame: DecodedFrame) -> float:
    """How much of an image came through, from 0 to 1: lost slots count nothing, and drowned ones little."""
    if frame.slot_snr_db is None or len(frame.slot_snr_db) == 0:
        return 1.0
    snr_db = np.nan_to_num(np.asarray(frame.slot_snr_db, dtype=np.float64), nan=-np.inf)
    return float(np.minimum(1.0, 10.0 ** (snr_db / 10.0) / _FULL_SNR).mean())


class Outage:
    """What share of the frames of late came through."""

    def __init__(self) -> None:
        self._shares: list[tuple[int, float]] = []

    def takes(self, frame: DecodedFrame) -> bool:
        """Note a frame, and tell whether it is one to be located only."""
        share = share_received(frame)
        now_ns = frame.t_source_ns  # which may stand still, or begin again where a video is repeated
        late = [(t_ns, seen) for t_ns, seen in self._shares if abs(now_ns - t_ns) < _REMEMBERED_NS]
        self._shares = [*late[-_MOST_FRAMES:], (now_ns, share)]
        usual = np.quantile([seen for _, seen in self._shares], _USUAL_QUANTILE)
        return share < _LEAST_SHARE * float(usual)
