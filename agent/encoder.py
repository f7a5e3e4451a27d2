"""From an image to the message with its channel symbols, encoded for the link as the receiver last saw it."""

import threading

from semcast.agent.source import SourceFrame
from semcast.common.codec import Codec
from semcast.common.messages import LinkReport, SymbolFrame
from semcast.common.phy.slots import layout_for
from semcast.common.rate import NATIVE_RATE, Rate, to_coded
from semcast.common.symbol_payload import pack_data_symbols


class LinkFeedback:
    """The SNR to encode for: the receiver's newest estimate, before the first one a fixed one.

    An estimate counts until the next: a server that is busy, or a long delay, makes reports late, and the
    link is then still more like the last report than like any fixed number.

    Args:
        agent_epoch: Reports of another epoch are ignored.
        initial_db: Before the first report.
    """

    def __init__(self, agent_epoch: int, initial_db: float) -> None:
        self._agent_epoch = agent_epoch
        self._initial_db = initial_db
        self._lock = threading.Lock()
        self._newest: LinkReport | None = None

    def update(self, report: LinkReport) -> None:
        """Take a report; older ones than the newest so far are ignored."""
        if report.agent_epoch != self._agent_epoch:
            return
        with self._lock:
            if self._newest is None or report.frame_id >= self._newest.frame_id:
                self._newest = report

    @property
    def reported_frame_id(self) -> int:
        """Newest frame the receiver reported on, -1 before the first."""
        with self._lock:
            return self._newest.frame_id if self._newest is not None else -1

    def snr_db(self) -> float:
        """Return the SNR to encode for."""
        with self._lock:
            return self._newest.snr_db_estimate if self._newest is not None else self._initial_db


class FrameEncoder:
    """Encodes frames and numbers them. Used from one thread.

    Args:
        codec: The sending end.
        agent_epoch: Of this start of the agent.
        lossless: Service the frames are sent in.
    """

    def __init__(self, codec: Codec, agent_epoch: int, lossless: bool) -> None:
        self._codec = codec
        self._agent_epoch = agent_epoch
        self._lossless = lossless
        self._next_seq = 0

    def encode(self, frame: SourceFrame, snr_db: float, rate: Rate = NATIVE_RATE) -> SymbolFrame:
        """Return the message for a frame; the next one has the next ``seq``.

        Args:
            frame: To encode.
            snr_db: Expected SNR of the link.
            rate: Channel uses per source value.

        Raises:
            ValueError: The codec's symbols don't fit the slot grid.
        """
        encoded = self._codec.encode(to_coded(frame.image, rate), snr_db)
        payload_format, payload = pack_data_symbols(encoded)
        layout = layout_for(encoded.shape_hw)
        message = SymbolFrame(
            agent_epoch=self._agent_epoch,
            seq=self._next_seq,
            frame_id=frame.frame_id,
            t_capture_ns=frame.t_capture_ns,
            t_source_ns=frame.t_source_ns,
            codec=self._codec.name,
            digest=self._codec.digest,
            image_hw=encoded.shape_hw,
            modulation=encoded.modulation,
            levels=encoded.levels.numbers,
            allocation=encoded.allocation,
            num_slots=layout.num_slots,
            uses_per_slot=layout.uses_per_slot,
            direction="tx",
            payload_format=payload_format,
            payload=payload,
            lossless=self._lossless,
            final=frame.final,
        )
        self._next_seq += 1
        return message
