"""Separate source and channel coding, the classical baseline: an image file over LDPC-coded QAM.

The bits fill exactly the data symbols every other codec has, pilots inside the same channel uses. ``*-ldpc``
is the paper's fixed scheme, rate 1/2 and 16-QAM; ``*-amc`` picks modulation and rate by the SNR the
transmitter expects and tells the receiver in a few known-sequence symbols.

Outage: when the CRC fails or nothing arrives, the image is mid-grey with confidence 0. Nothing is carried
over from earlier frames.

Confidence: the transmitter knows what compression cost. It sends, in eight bytes, the mean of the pixel label
``1 - tanh(30 |x_hat - x|)`` for eight classes of local activity of the decoded image; the receiver reads each
pixel's confidence from that table. It is calibrated by construction and sees no channel damage, because a
frame that passes its CRC has none.
"""

import hashlib
import logging
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import (
    LABEL_SHARPNESS,
    LOST_SLOT_SNR_DB,
    OUTAGE_GREY,
    DecodedImage,
    EncodedImage,
    Modulation,
    ReceivedImage,
    check_fixed_rate,
)
from semcast.common.conventional_source import (
    AVIF_SLOW_SPEED,
    AVIF_SPEED,
    ImageFormat,
    compress_to_fit,
    decompress,
)
from semcast.common.conventional_transport import Transport
from semcast.common.phy.hashing import hash_words, hashed_qpsk
from semcast.common.phy.qam import indices_to_symbols
from semcast.common.phy.slots import SlotLayout, layout_for
from semcast.common.shapes import check_shape

logger = logging.getLogger(__name__)

#: No link is better; what is said to be is finite this way.
_MAX_SNR_DB = 100.0
#: Standard deviation of grey levels in an 8x8 window that separates the classes of activity.
_ACTIVITY_EDGES = (1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 35.0)
_NUM_CLASSES = len(_ACTIVITY_EDGES) + 1
_MODE_KEY = 3
_MODE_SYMBOLS = 64
_FILLER_KEY = 4


class Mode(NamedTuple):
    """A modulation and a code rate.

    Attributes:
        bits_per_symbol: 2, 4 or 6.
        rate: Information bits per coded bit.
        min_snr_db: Link SNR from which on it is chosen: at ``MODE_MARGIN_DB`` less at most one of fifty
            768x512 images is lost (measured, AWGN with pilots).
    """

    bits_per_symbol: int
    rate: float
    min_snr_db: float


MODE_MARGIN_DB = 0.5
FIXED_MODE = Mode(bits_per_symbol=4, rate=0.5, min_snr_db=6.7)
#: Modulations and rates of 5G NR (3GPP TS 38.214, table 5.1.3.1-1), but where two have about as many bits the
#: one that needs less SNR: QPSK to rate .66, and 16-QAM to rate .84, where 5G turns to 64-QAM at .64.
#: Ascending in bits per channel use; the receiver learns the position in this table.
ADAPTIVE_MODES = (
    Mode(2, 120 / 1024, -20.0),
    Mode(2, 157 / 1024, -4.3),
    Mode(2, 193 / 1024, -3.6),
    Mode(2, 251 / 1024, -2.3),
    Mode(2, 308 / 1024, -1.4),
    Mode(2, 379 / 1024, -0.3),
    Mode(2, 449 / 1024, 0.7),
    Mode(2, 526 / 1024, 1.6),
    Mode(2, 602 / 1024, 2.7),
    Mode(2, 679 / 1024, 3.6),
    Mode(4, 378 / 1024, 4.6),
    Mode(4, 434 / 1024, 5.5),
    Mode(4, 490 / 1024, 6.4),
    Mode(4, 553 / 1024, 7.3),
    Mode(4, 616 / 1024, 8.6),
    Mode(4, 658 / 1024, 9.1),
    Mode(4, 700 / 1024, 9.8),
    Mode(4, 740 / 1024, 10.3),
    Mode(4, 790 / 1024, 11.1),
    Mode(4, 822 / 1024, 11.5),
    Mode(4, 860 / 1024, 12.1),
    Mode(6, 616 / 1024, 13.2),
    Mode(6, 666 / 1024, 14.1),
    Mode(6, 719 / 1024, 15.2),
    Mode(6, 772 / 1024, 16.1),
    Mode(6, 822 / 1024, 17.0),
    Mode(6, 873 / 1024, 18.1),
    Mode(6, 910 / 1024, 19.0),
    Mode(6, 948 / 1024, 20.1),
)


def _activity_class(image: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return the class of each pixel by the spread of grey levels around it."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (8, 8))
    variance = cv2.blur(grey * grey, (8, 8)) - mean * mean
    return np.digitize(np.sqrt(np.maximum(variance, 0.0)), _ACTIVITY_EDGES)


def _confidence_table(image: NDArray[np.uint8], decoded: NDArray[np.uint8]) -> bytes:
    """Return the mean pixel label of each activity class in 1/255; empty classes give 255."""
    error = cv2.absdiff(image, decoded).astype(np.float32).mean(axis=2) / 255.0
    label = 1.0 - np.tanh(LABEL_SHARPNESS * error)
    classes = _activity_class(decoded).reshape(-1)
    count = np.bincount(classes, minlength=_NUM_CLASSES)
    total = np.bincount(classes, weights=label.reshape(-1), minlength=_NUM_CLASSES)
    mean = np.where(count > 0, total / np.maximum(count, 1), 1.0)
    return np.rint(255.0 * mean).astype(np.uint8).tobytes()


class ConventionalCodec:
    """JPEG, WebP or AVIF over LDPC and QAM. One instance keeps the code of the last image size."""

    def __init__(
        self,
        image_format: ImageFormat,
        *,
        adaptive: bool = False,
        slow: bool = False,
        modulation: Modulation = "16qam",
    ) -> None:
        """Build the codec.

        Args:
            image_format: Source code.
            adaptive: Choose modulation and rate by the expected SNR instead of 16-QAM at rate 1/2.
            slow: Take longer over an AVIF file for a better image; other formats have no such choice.
            modulation: How the symbols travel; the points are the same, ``"analog"`` sends them as I/Q
                samples. Adaptive modulation always does, since its points are not 16-QAM alone.
        """
        self._format: ImageFormat = image_format
        self._modes = ADAPTIVE_MODES if adaptive else (FIXED_MODE,)
        self._adaptive = adaptive
        self._slow = slow
        self.modulation: Modulation = "analog" if adaptive else modulation
        self._quality_hint = 30
        self._told_of_no_room = False
        self._layout: SlotLayout | None = None
        self._transports: dict[int, Transport | None] = {}

    @property
    def name(self) -> str:
        """Registry name."""
        return f"{self._format}{'-slow' if self._slow else ''}-{'amc' if self._adaptive else 'ldpc'}"

    @property
    def digest(self) -> str:
        """First 16 hex digits of the sha256 of what both ends must agree on."""
        agreed = repr((self._format, self._modes, _ACTIVITY_EDGES, _MODE_SYMBOLS))
        return hashlib.sha256(agreed.encode()).hexdigest()[:16]

    def encode(self, image: NDArray[np.uint8], snr_db: float) -> EncodedImage:
        """Encode one image; one too small for any file is sent empty, an outage, which is warned of once.

        Args:
            image: ``(H, W, 3)`` uint8 RGB.
            snr_db: Expected link SNR; used by the adaptive variant only.

        Raises:
            ValueError: The image has another shape or dtype.
        """
        check_shape(image, "H W 3", "image")
        if image.dtype != np.uint8:
            raise ValueError(f"image must be uint8, got {image.dtype}")
        shape_hw = (image.shape[0], image.shape[1])
        layout = layout_for(shape_hw)
        mode_idx = self._choose_mode(layout, snr_db)
        transport = self._transport(layout, mode_idx)
        if transport is None:
            self._tell_of_no_room(shape_hw, 0)
            symbols = self._filler(layout)
        else:
            payload = self._payload(image, transport.capacity_bytes)
            if not payload:
                self._tell_of_no_room(shape_hw, transport.capacity_bytes)
            symbols = transport.encode(payload)
        header = self._header_per_slot(layout)
        data = np.empty((layout.num_slots, layout.data_per_slot), dtype=np.complex64)
        if header:
            data[:, :header] = self._mode_words(layout)[mode_idx]
        data[:, header:] = symbols.reshape(layout.num_slots, -1)
        return EncodedImage(shape_hw=shape_hw, symbols=data, modulation=self.modulation)

    def decode(self, received: ReceivedImage) -> DecodedImage:
        """Decode one frame; a frame whose CRC fails comes back mid-grey, as an outage.

        Values that are not finite count as lost.

        Raises:
            ValueError: Sizes contradict each other.
        """
        payload = self._receive(received)
        image = None
        if payload is not None and len(payload) > _NUM_CLASSES:
            image = decompress(payload[_NUM_CLASSES:], received.shape_hw)
        if payload is None or image is None:
            return DecodedImage(
                image=np.full((*received.shape_hw, 3), OUTAGE_GREY, dtype=np.uint8),
                confidence=np.zeros(received.shape_hw, dtype=np.float32),
                outage=True,
            )
        table = np.frombuffer(payload[:_NUM_CLASSES], dtype=np.uint8).astype(np.float32) / np.float32(255.0)
        return DecodedImage(image=image, confidence=table[_activity_class(image)])

    def _payload(self, image: NDArray[np.uint8], capacity_bytes: int) -> bytes:
        budget = capacity_bytes - _NUM_CLASSES
        speed = AVIF_SLOW_SPEED if self._slow else AVIF_SPEED
        found = None
        if budget > 0:
            found = compress_to_fit(image, self._format, budget, self._quality_hint, speed)
        if found is None:
            return b""
        self._quality_hint, data = found
        decoded = decompress(data, (image.shape[0], image.shape[1]))
        return b"" if decoded is None else _confidence_table(image, decoded) + data

    def _tell_of_no_room(self, shape_hw: tuple[int, int], capacity_bytes: int) -> None:
        """Say once that frames are sent empty: at the receiver that looks like a link that is too poor."""
        if not self._told_of_no_room:
            logger.warning(
                "%s: a frame of %dx%d pixels carries %d bytes, too few for any file of the image, so it "
                "is sent empty; larger images, a higher --rate or a learned codec get through",
                *(self.name, shape_hw[1], shape_hw[0], capacity_bytes),
            )
        self._told_of_no_room = True

    def _receive(self, received: ReceivedImage) -> bytes | None:
        layout = layout_for(received.shape_hw)
        check_shape(received.symbols, f"{layout.num_slots} {layout.data_per_slot}", "symbols")
        check_shape(received.effective_snr_db, f"{layout.num_slots}", "effective_snr_db")
        check_fixed_rate(received)
        arrived = np.isfinite(received.symbols)
        snr_db = np.where(arrived.all(axis=1), received.effective_snr_db, LOST_SLOT_SNR_DB)
        snr_db = np.nan_to_num(snr_db.astype(np.float64), nan=LOST_SLOT_SNR_DB)
        snr_db = snr_db.clip(LOST_SLOT_SNR_DB, _MAX_SNR_DB)
        snr = 10.0 ** (snr_db / 10.0)
        erased = snr_db <= LOST_SLOT_SNR_DB
        # The MMSE estimate is shrunk by snr / (1 + snr); undone, the noise variance is 1 / snr.
        symbols = np.where(arrived, received.symbols, 0)
        unbiased = symbols * ((1.0 + snr) / snr)[:, None].astype(np.float32)
        header = self._header_per_slot(layout)
        mode_idx = 0
        if header:
            words = self._mode_words(layout)
            weight = np.where(erased, 0.0, snr)[:, None]
            mode_idx = int(
                np.argmax([np.sum(weight * (np.conj(w) * unbiased[:, :header]).real) for w in words])
            )
        transport = self._transport(layout, mode_idx)
        if transport is None:
            return None
        per_slot = layout.data_per_slot - header
        return transport.decode(
            unbiased[:, header:].reshape(-1),
            np.repeat((1.0 / snr).astype(np.float32), per_slot),
            np.repeat(erased, per_slot),
        )

    def _header_per_slot(self, layout: SlotLayout) -> int:
        """Return how many symbols of each slot name the mode."""
        if not self._adaptive:
            return 0
        return min(-(-_MODE_SYMBOLS // layout.num_slots), layout.data_per_slot // 4)

    def _mode_words(self, layout: SlotLayout) -> NDArray[np.complex64]:
        """Return ``(num_modes, num_slots, header)`` pseudo-random QPSK words, one per mode."""
        shape = (len(self._modes), layout.num_slots, self._header_per_slot(layout))
        return hashed_qpsk(hash_words(int(np.prod(shape)), _MODE_KEY)).reshape(shape)

    def _choose_mode(self, layout: SlotLayout, snr_db: float) -> int:
        """Return the fastest mode that works at the expected SNR and has room for a block at all."""
        fitting = [k for k, mode in enumerate(self._modes) if mode.min_snr_db <= snr_db]
        usable = [k for k in fitting if self._transport(layout, k) is not None]
        return usable[-1] if usable else 0

    def _transport(self, layout: SlotLayout, mode_idx: int) -> Transport | None:
        """Return the code of a mode for an image size, None when the image has too few symbols for it."""
        if layout != self._layout:
            self._layout = layout
            self._transports = {}
        if mode_idx not in self._transports:
            mode = self._modes[mode_idx]
            num_symbols = layout.num_slots * (layout.data_per_slot - self._header_per_slot(layout))
            try:
                self._transports[mode_idx] = Transport(num_symbols, mode.bits_per_symbol, mode.rate)
            except ValueError:
                self._transports[mode_idx] = None
        return self._transports[mode_idx]

    def _filler(self, layout: SlotLayout) -> NDArray[np.complex64]:
        num_symbols = layout.num_slots * (layout.data_per_slot - self._header_per_slot(layout))
        return indices_to_symbols((hash_words(num_symbols, _FILLER_KEY) >> np.uint64(60)).astype(np.uint8))
