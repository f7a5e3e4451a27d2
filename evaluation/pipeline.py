"""Frames from a recording through codec and link to the decoded image, in one process and without a network.

Lossless and deterministic: every frame is sent, in order, and a frame's channel depends on the seed and the
frame number alone. It is the same codec, link and equaliser the processes run.
"""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.codec import (
    DEFAULT_CODEC,
    MODULATION_HELP,
    PRECISION_HELP,
    Codec,
    DecodedImage,
    Modulation,
    Precision,
)
from semcast.common.codecs import load_codec
from semcast.common.config import check_at_least
from semcast.common.cores import check_threads
from semcast.common.errors import ConfigError, SourceError
from semcast.common.link_report import LinkReporter
from semcast.common.phy.pilots import insert_pilots
from semcast.common.playback import check_playback
from semcast.common.sequence import Sequence as RecordedSequence
from semcast.common.sequence import open_sequence
from semcast.evaluation.sounding import told_at_first
from semcast.evaluation.trace_snr import check_snrs
from semcast.server.mapping.settings import MAX_SEED, ReconstructionSettings

logger = logging.getLogger(__name__)

#: Name under which the original images are used as they are: the best any codec and link could do.
CLEAN = "none"
#: Fields of a ``link`` that have no meaning in evaluations: the SNR is a list, and nothing is delayed.
UNUSED_LINK_FIELDS = frozenset({"link.snr_db", "link.delay_ms", "link.jitter_ms"})
#: The same of evaluations that are one run, whose seed is also that of the search.
UNUSED_IN_ONE_RUN = UNUSED_LINK_FIELDS | {"reconstruction.seed", "reconstruction.final_adjustment", "seeds"}

#: Decoded frames kept for further passes; beyond it frames are sent and decoded again.
CACHE_BYTES = 2 * 1024**3
#: Original images kept from when the frames were chosen; those beyond it are read again for each pass.
ORIGINALS_BYTES = 256 * 1024**2


def check_seeds(seed: int, seeds: int = 1) -> None:
    """Check that each of ``seeds`` seeds from ``seed`` upwards is one that every evaluation takes.

    Raises:
        ValueError: One is not, or there is none.
    """
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
    if seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    if (last := seed + seeds - 1) > MAX_SEED:
        raise ValueError(f"last of the seeds must be at most {MAX_SEED}, got {last}")


@dataclass(frozen=True, kw_only=True)
class StreamSettings:
    """What every evaluation has in common: which frames travel how.

    Raises:
        ValueError: A value is out of range.
    """

    sequence: Path = field(
        metadata={"help": "recorded sequence: native, TUM, KITTI, EuRoC, transforms.json or COLMAP"}
    )
    camera: CameraSettings = field(
        default=CameraSettings(), metadata={"help": "intrinsics, where the recording has none"}
    )
    codec: str = field(
        default=DEFAULT_CODEC,
        metadata={"help": f"codec by name or .safetensors file; {CLEAN}: original images, confidence 1"},
    )
    modulation: Modulation = field(default="16qam", metadata={"help": MODULATION_HELP})
    snr_db: tuple[float, ...] = field(default=(10.0,), metadata={"help": "SNRs in dB, one or more"})
    link: ChannelSettings = field(default=ChannelSettings(), metadata={"help": "the channel"})
    seed: int = field(default=0, metadata={"help": "first seed of channel and estimation"})
    seeds: int = field(default=1, metadata={"help": "number of seeds, from --seed upwards"})
    start: int = field(default=0, metadata={"help": "index of the first frame"})
    max_frames: int | None = field(default=None, metadata={"help": "frames used at most"})
    stride: int = field(default=1, metadata={"help": "use every n-th frame"})
    resize: float = field(default=1.0, metadata={"help": "factor on the image size, at most 1"})
    threads: int = field(default=2, metadata={"help": "threads of the codec"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    json: Path | None = field(default=None, metadata={"help": "file for the result, - for stdout"})

    def __post_init__(self) -> None:
        """Check ranges."""
        check_snrs(self.snr_db, self.link)
        check_at_least(self, start=0)
        check_seeds(self.seed, self.seeds)
        check_threads(self.threads)
        check_playback(resize=self.resize, stride=self.stride, max_frames=self.max_frames)

    @property
    def all_seeds(self) -> range:
        """The seeds of the run."""
        return range(self.seed, self.seed + self.seeds)

    def link_at(self, snr_db: float) -> ChannelSettings:
        """Return the channel settings for one of the SNRs."""
        return replace(self.link, snr_db=snr_db)


@dataclass(frozen=True, kw_only=True)
class OneRunSettings(StreamSettings):
    """What evaluations have in common that reconstruct once: a single SNR and seed.

    Raises:
        ValueError: A value is out of range.
    """

    snr_db: tuple[float, ...] = field(default=(10.0,), metadata={"help": "SNR in dB, a single one"})
    reconstruction: ReconstructionSettings = field(
        default=ReconstructionSettings(), metadata={"help": "the server's estimation"}
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if len(self.snr_db) != 1 or self.seeds != 1:
            raise ValueError(f"snr_db and seeds must be one each, got {self.snr_db} and {self.seeds} seeds")

    @property
    def the_link(self) -> ChannelSettings:
        """Channel of the run."""
        return self.link_at(self.snr_db[0])

    @property
    def estimation(self) -> ReconstructionSettings:
        """Estimation of the run, with its seed."""
        return replace(self.reconstruction, seed=self.seed)


@dataclass(frozen=True)
class LinkedFrame:
    """One frame at both ends of the link.

    Attributes:
        frame_id: Index in the recording, whatever the stride.
        t_source_ns: Recorded time.
        original: ``(H, W, 3)`` uint8 RGB.
        decoded: What the receiver has; None when the frame was lost or nothing usable arrived.
        row_snr_db: ``(num_slots,)`` of each row of blocks at the receiver; None for clean or lost frames.
        snr_db_estimate: The receiver's estimate of the link SNR; None for clean or lost frames.
        stage_ms: Duration of ``encode``, ``channel``, ``equalise`` and ``decode``, as far as run.
    """

    frame_id: int
    t_source_ns: int
    original: NDArray[np.uint8]
    decoded: DecodedImage | None
    row_snr_db: NDArray[np.float32] | None
    snr_db_estimate: float | None
    stage_ms: dict[str, float]

    @property
    def num_bytes(self) -> int:
        """Memory of the arrays."""
        total = self.original.nbytes
        if self.decoded is not None:
            total += self.decoded.image.nbytes + self.decoded.confidence.nbytes
            if self.decoded.keypoint_confidence is not None:
                total += self.decoded.keypoint_confidence.nbytes
        return total


def _elapsed_ms(since_ns: int) -> float:
    return (time.perf_counter_ns() - since_ns) * 1e-6


@dataclass(frozen=True)
class Selection:
    """Frames of a recording that an evaluation sends.

    Attributes:
        ids: Indices in the recording, increasing.
        left_out: Those that were chosen and whose image can't be read: an agent leaves them out as well.
        images: Index -> image, ``(H, W, 3)`` uint8 RGB, of those that were kept when they were read.
    """

    ids: list[int]
    left_out: list[int]
    images: dict[int, NDArray[np.uint8]]


def select_frames(sequence: RecordedSequence, settings: StreamSettings, *, keep_bytes: int = 0) -> Selection:
    """Return the frames that ``start``, ``stride`` and ``max_frames`` choose; what can't be read is left out.

    Args:
        sequence: The recording.
        settings: What chooses them.
        keep_bytes: Of their images the first are kept, as far as they fit in. An evaluation that measures its
            own memory keeps none.

    Raises:
        ConfigError: None is chosen.
        SourceError: None of them can be read.
    """
    ids = list(range(settings.start, len(sequence), settings.stride))
    if not ids:
        raise ConfigError(
            f"start must be below the {len(sequence)} frames of the sequence, got {settings.start}"
        )
    left_out: list[int] = []
    images: dict[int, NDArray[np.uint8]] = {}
    for frame_id in (ids := ids[: settings.max_frames]):
        try:
            image = sequence.image(frame_id)
            if (len(images) + 1) * image.nbytes <= keep_bytes:  # all are of one size
                images[frame_id] = image
        except SourceError as err:
            if len(left_out) == len(ids) - 1:
                raise
            logger.warning("frame %d is left out: %s", frame_id, err)
            left_out.append(frame_id)
    return Selection([frame_id for frame_id in ids if frame_id not in left_out], left_out, images)


def run_frames(
    sequence: RecordedSequence,
    frame_ids: Sequence[int],
    codec: Codec | None,
    link: Link | None,
    images: Mapping[int, NDArray[np.uint8]] | None = None,
) -> Iterator[LinkedFrame]:
    """Send frames of a recording through a codec and a link, one after the other.

    The encoder is told what the agent would be told: the receiver's report on the last frame that
    arrived; before the first one, see ``told_at_first``.

    Args:
        sequence: The recording.
        frame_ids: Frames to send, increasing.
        codec: Both ends; None together with ``link`` gives the originals with confidence 1.
        link: The channel.
        images: Of frames whose image need not be read again.

    Raises:
        ValueError: Only one of ``codec`` and ``link`` is given.
        SourceError: A frame can't be read.
    """
    if (codec is None) != (link is None):
        raise ValueError("codec and link must be given both or neither")
    reporter = LinkReporter(codec.name) if codec is not None else None
    feedback_db: float | None = None
    for frame_id in frame_ids:
        original = images[frame_id] if images and frame_id in images else sequence.image(frame_id)
        t_source_ns = int(sequence.times_ns[frame_id])
        if codec is None or link is None or reporter is None:
            clean = DecodedImage(original, np.ones(original.shape[:2], dtype=np.float32))
            yield LinkedFrame(frame_id, t_source_ns, original, clean, None, None, {})
            continue
        if feedback_db is None:
            feedback_db = told_at_first(codec, original, link, reporter, t_source_ns * 1e-9)
        stage_ms: dict[str, float] = {}
        since = time.perf_counter_ns()
        encoded = codec.encode(original, feedback_db)
        stage_ms["encode"] = _elapsed_ms(since)
        since = time.perf_counter_ns()
        sent = link.transmit(insert_pilots(encoded.symbols), t_source_ns * 1e-9, frame_id)
        stage_ms["channel"] = _elapsed_ms(since)
        if sent.frame_lost:
            yield LinkedFrame(frame_id, t_source_ns, original, None, None, None, stage_ms)
            continue
        since = time.perf_counter_ns()
        equalised = sent.equalise(encoded)
        stage_ms["equalise"] = _elapsed_ms(since)
        feedback_db = reporter.snr_db(equalised)
        since = time.perf_counter_ns()
        decoded = codec.decode(equalised.received)
        stage_ms["decode"] = _elapsed_ms(since)
        yield LinkedFrame(
            frame_id,
            t_source_ns,
            original,
            None if decoded.outage else decoded,
            equalised.received.row_snr_db,
            equalised.snr_db,
            stage_ms,
        )


class FrameRun:
    """The frames of one SNR and seed, iterated as often as needed.

    The first complete pass is kept in memory up to a budget, so that several ways of estimation see the very
    same decoded images without decoding again. Above the budget each pass sends and decodes anew, with the
    same result.

    Args:
        sequence: The recording.
        frame_ids: Frames to send.
        codec: Both ends, or None for clean originals.
        link: Settings of the channel.
        seed: Seed of the channel.
        images: Of frames whose image need not be read again, as ``select_frames`` keeps them.
        cache_bytes: Memory budget; 0 keeps nothing.
    """

    def __init__(
        self,
        sequence: RecordedSequence,
        frame_ids: Sequence[int],
        codec: Codec | None,
        link: ChannelSettings,
        seed: int,
        *,
        images: Mapping[int, NDArray[np.uint8]] | None = None,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        self._sequence = sequence
        self._frame_ids = list(frame_ids)
        self._codec = codec
        self._link = link
        self._seed = seed
        self._images = images
        self._cache_bytes = cache_bytes
        self._kept: list[LinkedFrame] | None = None

    def __len__(self) -> int:
        return len(self._frame_ids)

    def __iter__(self) -> Iterator[LinkedFrame]:
        """Yield the frames in order."""
        if self._kept is not None:
            yield from self._kept
            return
        link = Link(self._link, self._seed) if self._codec is not None else None
        kept: list[LinkedFrame] | None = []
        num_bytes = 0
        for frame in run_frames(self._sequence, self._frame_ids, self._codec, link, self._images):
            num_bytes += frame.num_bytes
            if num_bytes > self._cache_bytes:
                kept = None
            if kept is not None:
                kept.append(frame)
            yield frame
        self._kept = kept


def open_stream(
    settings: StreamSettings, codec: Codec | None = None
) -> tuple[RecordedSequence, Codec | None]:
    """Open the recording and load the codec that settings name.

    Args:
        settings: What to run.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        The recording, and the codec or None for ``codec = "none"``.

    Raises:
        SourceError: The recording can't be read.
        ConfigError: The codec is unknown.
        CheckpointError: Its weights are missing or damaged.
    """
    sequence = open_sequence(settings.sequence, settings.camera, resize=settings.resize)
    if codec is None and settings.codec != CLEAN:
        codec = load_codec(
            settings.codec,
            modulation=settings.modulation,
            num_threads=settings.threads,
            precision=settings.precision,
        )
    return sequence, codec
