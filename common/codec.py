"""The codec interface: an image becomes channel symbols at one end and an image with confidence at the other.

A codec never sees pilots, fading or packets. It fills the data symbols of every slot (see
``semcast.common.phy.slots``) and gets them back equalised, together with the SNR each slot really had.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from semcast.common.config import near_match
from semcast.common.errors import ConfigError
from semcast.common.levels import ALL_LEVELS, Levels
from semcast.common.phy.allocation import Allocation
from semcast.common.phy.slots import layout_for

Modulation = Literal["16qam", "analog"]
MODULATIONS: tuple[Modulation, ...] = get_args(Modulation)
MODULATION_HELP = "how symbols travel: 16qam or analog"

#: What the convolutions of a learned codec are computed in.
Precision = Literal["auto", "float32", "bfloat16", "int8"]
#: Of every command that computes them.
PRECISION_HELP = "arithmetic of a learned codec's convolutions; auto: the fastest of this processor"

#: Where a learned codec is computed; auto: on a GPU where there is one.
Device = Literal["auto", "cpu", "cuda"]

#: Codec of every command that is not told another.
DEFAULT_CODEC = "3dcsc-lite-vr"

#: Side of the window in which keypoints are tracked, and whose displacement the keypoint confidence predicts.
KLT_WINDOW_PX = 21

#: alpha of the label pixel confidence is trained on (paper, Eq. 11): ``1 - tanh(alpha |x_hat - x|)``, with
#: images in [0, 1].
LABEL_SHARPNESS = 30.0

#: Grey level of an image of which nothing usable arrived.
OUTAGE_GREY = 128

#: Effective SNR given to the decoder for a slot of which nothing arrived.
LOST_SLOT_SNR_DB = -20.0


def check_modulation(modulation: str) -> None:
    """Check that there is a modulation of this name.

    Raises:
        ConfigError: There is none.
    """
    if modulation not in MODULATIONS:
        hint = near_match(modulation, list(MODULATIONS))
        raise ConfigError(f"modulation must be one of {', '.join(MODULATIONS)}, got {modulation!r}{hint}")


@dataclass(frozen=True)
class EncodedImage:
    """Data symbols of one frame, before pilots.

    Attributes:
        shape_hw: Height and width of the image in pixels, before padding to whole blocks.
        symbols: ``(num_slots, data_per_slot)`` complex64, mean ``|s|^2`` over the frame near 1: a learned
            encoder need not use all points alike, and the link scales what it is given. Under ``"16qam"``
            every symbol is a point of the Gray-mapped constellation in ``phy/qam.py``, plain or shaped.
        modulation: How the symbols travel.
        levels: What the image's grey levels were stretched from; it travels with the frame's header.
        allocation: Code of how many values each block sends (``phy.allocation``), in the header too; empty
            at a fixed rate.
    """

    shape_hw: tuple[int, int]
    symbols: NDArray[np.complex64]
    modulation: Modulation
    levels: Levels = ALL_LEVELS
    allocation: bytes = b""

    def arrived(
        self, symbols: NDArray[np.complex64], effective_snr_db: NDArray[np.float32]
    ) -> "ReceivedImage":
        """Return what is received of it: equalised symbols of the same shape, ``(num_slots,)`` SNRs."""
        return ReceivedImage(
            self.shape_hw, symbols, effective_snr_db, self.modulation, self.levels, self.allocation
        )


@dataclass(frozen=True)
class ReceivedImage:
    """Data symbols of one frame after equalisation.

    Attributes:
        shape_hw: Height and width of the image in pixels.
        symbols: ``(num_slots, data_per_slot)`` complex64, the linear MMSE estimate
            ``conj(h) y / (|h|^2 + noise_var)``: shrunk by ``snr / (1 + snr)``, zero for a lost slot.
        effective_snr_db: ``(num_slots,)`` float32, ``|h|^2 / noise_var`` of each slot in dB as the
            receiver estimated it, never below ``LOST_SLOT_SNR_DB``.
        modulation: How the symbols travelled.
        levels: What the image's grey levels were stretched from.
        allocation: Code of how many values each block sends.
    """

    shape_hw: tuple[int, int]
    symbols: NDArray[np.complex64]
    effective_snr_db: NDArray[np.float32]
    modulation: Modulation
    levels: Levels = ALL_LEVELS
    allocation: bytes = b""

    @property
    def row_snr_db(self) -> NDArray[np.float32]:
        """``(num_slots,)`` SNR of each row of blocks, which is a slot at a fixed rate.

        Raises:
            ValueError: ``allocation`` is no code of so many blocks.
        """
        if not self.allocation:
            return self.effective_snr_db
        layout = layout_for(self.shape_hw)
        grid = (layout.num_slots, layout.blocks_per_slot)
        return Allocation.from_code(self.allocation, grid).row_snr_db(self.effective_snr_db)


@dataclass(frozen=True)
class DecodedImage:
    """What the receiver hands to the geometry.

    Attributes:
        image: ``(H, W, 3)`` uint8 RGB.
        confidence: ``(H, W)`` float32 in [0, 1], 1 is fully trusted: the paper's pixel-error target.
        keypoint_confidence: ``(H, W)`` float32 in [0, 1] trained on keypoint displacement, or None where the
            codec has no such head. ``displacement_px`` recovers the expected displacement from it.
        outage: True when nothing usable arrived and ``image`` is only a filler.
    """

    image: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    keypoint_confidence: NDArray[np.float32] | None = None
    outage: bool = False


def check_fixed_rate(received: ReceivedImage) -> None:
    """Make sure that a frame was sent at a fixed rate.

    Raises:
        ValueError: It has an allocation.
    """
    if received.allocation:
        raise ValueError(
            f"allocation must be empty for a codec of fixed rate, got {len(received.allocation)} bytes"
        )


def confidence_from_displacement_px(displacement_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Map an expected keypoint displacement in pixels to a confidence: ``1 / (1 + d)``."""
    return (1.0 / (1.0 + displacement_px)).astype(np.float32)


def displacement_px(keypoint_confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Invert ``confidence_from_displacement_px``; confidence 0 gives a large finite displacement."""
    return (1.0 / np.maximum(keypoint_confidence, 1e-3) - 1.0).astype(np.float32)


class Codec(Protocol):
    """Both ends of one transceiver. Implementations own their buffers and are used from one thread."""

    @property
    def name(self) -> str:
        """Registry name, such as ``3dcsc-lite``."""

    @property
    def digest(self) -> str:
        """First 16 hex digits of the sha256 of the weights, or of the settings where there are none."""

    @property
    def modulation(self) -> Modulation:
        """How what it encodes travels."""

    def encode(self, image: NDArray[np.uint8], snr_db: float) -> EncodedImage:
        """Encode one ``(H, W, 3)`` uint8 RGB image for a link whose expected SNR is ``snr_db``."""

    def decode(self, received: ReceivedImage) -> DecodedImage:
        """Decode one frame; never raises on damaged symbols."""
