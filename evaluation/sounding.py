"""What a transmitter is told before its first picture, when no receiver has reported anything."""

import numpy as np
from numpy.typing import NDArray

from semcast.channel.link import Link
from semcast.common.codec import LOST_SLOT_SNR_DB, Codec
from semcast.common.codecs import is_conventional
from semcast.common.link_report import LinkReporter

#: Number of the frame that sounds the link, beyond those of any recording: numbers decide on the noise.
_SOUNDING_FRAME = 10**6


def told_at_first(
    codec: Codec,
    image: NDArray[np.uint8],
    link: Link,
    reporter: LinkReporter,
    t_s: float,
    *,
    perfect_csi: bool = False,
) -> float:
    """Return the SNR in dB that the transmitter is told before the first picture.

    A learned codec is told the SNR that is set for it, by a trace where there is one. One that chooses a rate
    asks the link first: it is told what the receiver reports on a frame that is not counted.

    Args:
        codec: The sending end.
        image: The first picture, of coded size.
        link: Nothing was sent through it yet.
        reporter: Of the stream; it learns from the frame.
        t_s: Time of the first picture.
        perfect_csi: See ``Link.receive``.
    """
    if not is_conventional(codec.name):
        return link.start_snr_db
    encoded = codec.encode(image, link.start_snr_db)
    sounding = link.receive(encoded, t_s, _SOUNDING_FRAME, perfect_csi=perfect_csi)
    return LOST_SLOT_SNR_DB if sounding is None else reporter.snr_db(sounding)
