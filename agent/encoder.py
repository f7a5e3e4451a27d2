"""From an image to the message with its channel symbols, encoded for the link as the receiver last saw it."""

import threading
import time
from collections.abc import Callable

from semcast.agent.source import SourceFrame
from semcast.common.codec import Codec
from semcast.common.messages import LinkReport, SymbolFrame
from semcast.common.phy.slots import layout_for
from semcast.common.rate import NATIVE_RATE, Rate, to_coded
from semcast.common.symbol_payload import pack_data_symbols


class LinkFeedback:
    """The SNR to encode for: the receiver's estimate while it is fresh, else a fixed one.

    Args:
        agent_epoch: Reports of another epoch are ignored.
        fallback_db: Without a fresh report.
        max_age_s: Age up to which a report counts, from the capture of the frame it is about.
        clock_ns: The clock ``t_capture_ns`` is of.
    """

    def __init__(
        self,
        agent_epoch: int,
        fallback_db: float,
        max_age_s: float,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._agent_epoch = agent_epoch
        self._fallback_db = fallback_db
        self._max_age_s = max_age_s
        self._clock_ns = clock_ns
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

    @property
    def age_s(self) -> float | None:
        """Time since the capture of the frame the newest report is about; None without one."""
        with self._lock:
            newest = self._newest
        return (self._clock_ns() - newest.t_capture_ns) * 1e-9 if newest is not None else None

    def snr_db(self) -> float:
        """Return the SNR to encode for."""
        age_s = self.age_s
        with self._lock:
            if self._newest is None or age_s is None or not 0.0 <= age_s <= self._max_age_s:
                return self._fallback_db
            return self._newest.snr_db_estimate


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
