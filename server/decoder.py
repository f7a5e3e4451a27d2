"""From equalised symbols to an image with confidence, by the codec each message names."""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import (
    LOST_SLOT_SNR_DB,
    Codec,
    DecodedImage,
    Device,
    Modulation,
    Precision,
    ReceivedImage,
)
from semcast.common.codecs import load_codec
from semcast.common.errors import CheckpointError, ProtocolError
from semcast.common.phy.slots import layout_for
from semcast.common.rate import from_coded
from semcast.server.mapping.state import DecodedFrame
from semcast.server.receiver import ReceivedFrame

logger = logging.getLogger(__name__)

CodecLoader = Callable[[str, Modulation], Codec]

#: Pixels a codec is warmed up with at most. A camera says itself how large its images are, and what it says
#: must not cost a minute and gigabytes before it has sent any.
MAX_WARM_UP_PX = 1920 * 1080


def codec_loader(
    num_threads: int,
    device: Device = "auto",
    weights: Path | None = None,
    only_of: str | None = None,
    precision: Precision = "auto",
) -> CodecLoader:
    """Return what loads codecs by name and modulation.

    Args:
        num_threads: CPU threads of a codec.
        device: Of a learned one.
        weights: Taken in place of the shipped ones.
        only_of: The codec they are for; others have the shipped ones. None: for any that is asked for, which
            must be theirs.
        precision: Of a learned one.
    """

    def load(name: str, modulation: Modulation) -> Codec:
        return load_codec(
            name,
            modulation=modulation,
            num_threads=num_threads,
            device=device,
            weights=weights if only_of in (None, name) else None,
            precision=precision,
        )

    return load


def tracker_frame(
    decoded: DecodedImage, frame_id: int, t_source_ns: int, slot_snr_db: NDArray[np.float32] | None
) -> DecodedFrame:
    """Return a decoded image as the tracker takes it.

    Args:
        decoded: At the size of the camera's images.
        frame_id: Of the frame.
        t_source_ns: Its recorded time.
        slot_snr_db: ``(num_slots,)`` SNR of each band of the camera's images, or None.
    """
    return DecodedFrame(
        frame_id=frame_id,
        t_source_ns=t_source_ns,
        image=decoded.image,
        confidence=decoded.confidence,
        keypoint_confidence=decoded.keypoint_confidence,
        slot_snr_db=slot_snr_db,
    )


@dataclass(frozen=True)
class DecodedArrival:
    """A received frame and, unless it was lost on the air, its image.

    Attributes:
        arrival: As received.
        frame: Ready for the tracker; None when nothing arrived or nothing usable did.
        decode_ms: Duration of the decoder.
        t_decoded_ns: Server clock (``perf_counter_ns``) when it was done.
    """

    arrival: ReceivedFrame
    frame: DecodedFrame | None
    decode_ms: float
    t_decoded_ns: int


@dataclass(frozen=True)
class Arrival:
    """What is known about a frame besides its image.

    Attributes:
        snr_set_db: What the channel node says it applies, None where it says nothing.
        snr_estimated_db: What the receiver estimated.
        t_arrival_ns: Server clock (``perf_counter_ns``) when the frame arrived.
        t_decoded_ns: The same when it was decoded; it may have waited for the tracker since.
        stage_ms: Stages before the tracker.
        drops: Frames that did not get this far, by reason, up to now.
    """

    snr_set_db: float | None
    snr_estimated_db: float | None
    t_arrival_ns: int
    t_decoded_ns: int
    stage_ms: Mapping[str, float]
    drops: Mapping[str, int]

    @classmethod
    def of(cls, decoded: DecodedArrival, drops: Mapping[str, int]) -> "Arrival":
        """Return what receiver and decoder say of a frame."""
        arrival = decoded.arrival
        return cls(
            snr_set_db=arrival.snr_db_set,
            snr_estimated_db=arrival.snr_db,
            t_arrival_ns=arrival.t_arrival_ns,
            t_decoded_ns=decoded.t_decoded_ns,
            stage_ms={"equalise": arrival.equalise_ms, "decode": decoded.decode_ms},
            drops=drops,
        )

    def stages_to_pose_ms(self, tracked_ns: int) -> dict[str, float]:
        """Return the stages before the tracker, and ``decoded_to_pose`` up to the pose at this time."""
        return {**self.stage_ms, "decoded_to_pose": (tracked_ns - self.t_decoded_ns) * 1e-6}


class FrameDecoder:
    """Decodes frames; codecs are loaded once. Safe to use from several threads, one at a time.

    Args:
        load: Returns the codec of a name and modulation, as ``common.codecs.load_codec`` does.
    """

    def __init__(self, load: CodecLoader) -> None:
        self._load = load
        self._codecs: dict[tuple[str, Modulation], Codec] = {}
        self._lock = threading.Lock()

    def load(self, name: str, modulation: Modulation) -> Codec:
        """Return a codec, loading it the first time.

        Raises:
            CheckpointError: Its weights are missing or damaged.
            ConfigError: There is no such codec.
        """
        key = (name, modulation)
        if key not in self._codecs:
            started_ns = time.perf_counter_ns()
            self._codecs[key] = self._load(name, modulation)
            logger.info("codec %s (%s) loaded in %.1f s", *key, (time.perf_counter_ns() - started_ns) * 1e-9)
        return self._codecs[key]

    def codec_for(self, name: str, modulation: Modulation, digest: str) -> Codec:
        """Return the codec of a stream.

        Raises:
            CheckpointError: The sender's weights are not the ones installed here.
            ConfigError: There is no such codec.
        """
        codec = self.load(name, modulation)
        if codec.digest != digest:
            raise CheckpointError(
                f"codec {name} has digest {codec.digest} here but {digest} at the agent: "
                "install the same version of semcast at both ends, or give both the same weights"
            )
        return codec

    def warm_up(self, name: str, modulation: Modulation, digest: str, shape_hw: tuple[int, int]) -> None:
        """Load a stream's codec and run it once on nothing, which is slower than all later frames.

        An image of more than ``MAX_WARM_UP_PX`` pixels is stood for by a smaller one.

        Raises:
            CheckpointError: See ``codec_for``.
            ConfigError: See ``codec_for``.
        """
        scale = min(1.0, math.sqrt(MAX_WARM_UP_PX / math.prod(shape_hw)))
        shape_hw = (max(1, math.floor(scale * shape_hw[0])), max(1, math.floor(scale * shape_hw[1])))
        layout = layout_for(shape_hw)
        nothing = ReceivedImage(
            shape_hw=shape_hw,
            symbols=np.zeros((layout.num_slots, layout.data_per_slot), dtype=np.complex64),
            effective_snr_db=np.full(layout.num_slots, LOST_SLOT_SNR_DB, dtype=np.float32),
            modulation=modulation,
        )
        with self._lock:
            self.codec_for(name, modulation, digest).decode(nothing)

    def decode(self, arrival: ReceivedFrame) -> DecodedArrival:
        """Decode one frame.

        Raises:
            CheckpointError: See ``codec_for``.
            ConfigError: See ``codec_for``.
            ProtocolError: What the frame says of itself is not its codec's.
        """
        message = arrival.message
        if arrival.received is None:
            return DecodedArrival(arrival, None, 0.0, time.perf_counter_ns())
        with self._lock:
            codec = self.codec_for(message.codec, message.modulation, message.digest)
            started_ns = time.perf_counter_ns()
            try:
                decoded = codec.decode(arrival.received)
            except ValueError as err:
                raise ProtocolError(
                    f"codec {message.codec} can't decode frame {message.frame_id}: {err}"
                ) from err
            decoded = from_coded(decoded, arrival.camera.intrinsics.shape_hw)
        t_decoded_ns = time.perf_counter_ns()
        decode_ms = (t_decoded_ns - started_ns) * 1e-6
        if decoded.outage:
            return DecodedArrival(arrival, None, decode_ms, t_decoded_ns)
        frame = tracker_frame(decoded, message.frame_id, message.t_source_ns, arrival.slot_snr_db)
        return DecodedArrival(arrival, frame, decode_ms, t_decoded_ns)
