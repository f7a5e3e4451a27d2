"""Channel uses per frame: one model serves several bandwidth ratios by the resolution at which it codes.

The slot grid ties 48 channel uses to a block of 16x16 pixels, so a frame coded at ``sqrt(16 / n)`` of its
size takes ``1/n`` complex uses per source value instead of 1/16. With the same weights this was better than
sending only the strongest directions of the latent, it reaches above 1/16 too, and works for every codec. At
1/16 the image stays as it is.
"""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import DecodedImage, confidence_from_displacement_px, displacement_px
from semcast.common.errors import ConfigError
from semcast.common.lost_detail import confidence_at_camera
from semcast.common.messages import MAX_PAYLOAD_BYTES, MAX_SIDE_PX, received_bytes
from semcast.common.phy.slots import BLOCK_PX, USES_PER_BLOCK, layout_for

Rate = Literal["1/48", "1/32", "1/24", "1/16", "1/12", "1/8"]
RateChoice = Literal["auto", Rate]
RATES: tuple[Rate, ...] = get_args(Rate)
NATIVE_RATE: Rate = "1/16"
#: SNR at which ``RateControl`` takes the native rate.
_NATIVE_SNR_DB = 10.0
#: A change of rate must be due by this share of a step, so that a noisy SNR does not make it flutter.
_HYSTERESIS = 0.75


def uses_per_value(rate: Rate) -> float:
    """Return complex channel uses, pilots included, per source value."""
    return 1.0 / int(rate.removeprefix("1/"))


def coded_shape(shape_hw: tuple[int, int], rate: Rate) -> tuple[int, int]:
    """Return the height and width in pixels at which an image is coded.

    Away from the native rate both are whole blocks, and their channel uses are never above the rate's unless
    that is less than two blocks by two.
    """
    if rate == NATIVE_RATE:
        return shape_hw
    height, width = shape_hw
    scale = math.sqrt(uses_per_value(rate) / uses_per_value(NATIVE_RATE))
    budget = height * width * 3 * uses_per_value(rate) / USES_PER_BLOCK
    # Of a narrow image fewer: columns are two at least.
    rows = max(2, min(round(height * scale / BLOCK_PX), math.floor(budget / 2)))
    return rows * BLOCK_PX, max(2, math.floor(budget / rows)) * BLOCK_PX


def belongs_to(coded_hw: tuple[int, int], shape_hw: tuple[int, int]) -> bool:
    """Whether an image of the first shape can be a coded one of a camera of the second."""
    return coded_hw == shape_hw or coded_hw in {coded_shape(shape_hw, rate) for rate in RATES}


def to_coded(image: NDArray[np.uint8], rate: Rate) -> NDArray[np.uint8]:
    """Return an ``(H, W, 3)`` image at the size at which it is coded; the image itself at the native rate."""
    height, width = coded_shape((image.shape[0], image.shape[1]), rate)
    if (height, width) == image.shape[:2]:
        return image
    how = cv2.INTER_AREA if height * width < image.shape[0] * image.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.uint8)


def from_coded(decoded: DecodedImage, shape_hw: tuple[int, int]) -> DecodedImage:
    """Return a decoded image and its maps at the camera's size.

    A keypoint's displacement grows with the size. Pixel confidence is that in the camera's picture: where the
    coded one is smaller it falls, most where there is detail (``lost_detail``).
    """
    coded_hw = decoded.image.shape[:2]
    if coded_hw == shape_hw:
        return decoded
    size_wh = (shape_hw[1], shape_hw[0])
    growth = math.sqrt(shape_hw[0] * shape_hw[1] / (coded_hw[0] * coded_hw[1]))
    keypoint = decoded.keypoint_confidence
    if keypoint is not None:
        moved_px = cv2.resize(displacement_px(keypoint), size_wh, interpolation=cv2.INTER_LINEAR)
        keypoint = confidence_from_displacement_px(np.float32(growth) * np.asarray(moved_px, np.float32))
    confidence = decoded.confidence
    if growth > 1.0:
        confidence = confidence_at_camera(confidence, decoded.image, 1.0 / growth)
    confidence = np.asarray(cv2.resize(confidence, size_wh, interpolation=cv2.INTER_LINEAR), np.float32)
    return replace(
        decoded,
        image=np.asarray(cv2.resize(decoded.image, size_wh, interpolation=cv2.INTER_CUBIC), np.uint8),
        confidence=confidence,
        keypoint_confidence=keypoint,
    )


def slots_at(values: NDArray[np.float32], coded_height: int, height: int) -> NDArray[np.float32]:
    """Return one value per slot of the camera's grid from one per slot of the coded one.

    Of the coded slots a band overlaps the smallest value counts: nothing lost may look sound.

    Args:
        values: ``(S,)`` of the coded slots.
        coded_height: Rows of the coded image in pixels.
        height: Rows of the camera's image in pixels.
    """
    if coded_height == height:
        return values
    num_slots = layout_for((height, 1)).num_slots
    edges = np.minimum(BLOCK_PX * np.arange(num_slots + 1), height) * coded_height / height / BLOCK_PX
    return np.array(
        [
            values[math.floor(top) : max(math.ceil(bottom - 1e-9), math.floor(top) + 1)].min()
            for top, bottom in pairwise(edges)
        ],
        dtype=np.float32,
    )


class RateControl:
    """Chooses the rate of each frame.

    Args:
        rate: A fixed one, or ``auto``: as many uses as carry the information that the native rate carries at
            10 dB, so that a good link is not filled for nothing and a bad one gets more time.
        shape_hw: Of the camera.

    Raises:
        ValueError: There is no such rate.
        ConfigError: Frames of this size are too large for the protocol at it.
    """

    def __init__(self, rate: RateChoice, shape_hw: tuple[int, int]) -> None:
        if rate != "auto" and rate not in RATES:
            raise ValueError(f"rate must be auto or one of {', '.join(RATES)}, got {rate!r}")
        size = f"{shape_hw[1]}x{shape_hw[0]}"
        self._rates = [known for known in RATES if _can_be_sent(shape_hw, known)]
        if not self._rates:
            raise ConfigError(f"resize must make frames smaller: those of {size} can be sent at no rate")
        if rate not in ("auto", *self._rates):
            allowed = ", ".join(self._rates)
            raise ConfigError(
                f"rate must be one of {allowed} for frames of {size}, got {rate!r}; resize makes them smaller"
            )
        self._fixed = None if rate == "auto" else rate
        self._shape_hw = shape_hw
        self._rate: Rate = min(self._rates, key=lambda known: abs(_log_uses(known) - _log_uses(NATIVE_RATE)))

    @property
    def num_uses(self) -> tuple[int, int]:
        """Fewest and most channel uses of a frame, pilots included."""
        rates = self._rates if self._fixed is None else [self._fixed]
        uses = [layout_for(coded_shape(self._shape_hw, rate)).num_uses for rate in rates]
        return min(uses), max(uses)

    def choose(self, snr_db: float) -> Rate:
        """Return the rate for a link of this SNR."""
        if self._fixed is not None:
            return self._fixed
        wanted = _log_uses(NATIVE_RATE) + math.log(
            _capacity_bits(_NATIVE_SNR_DB) / max(_capacity_bits(snr_db), 1e-6)
        )
        steps = [_log_uses(rate) for rate in self._rates]
        place = float(np.interp(wanted, steps, range(len(steps))))
        if abs(place - self._rates.index(self._rate)) > _HYSTERESIS:
            self._rate = self._rates[round(place)]
        return self._rate


def _log_uses(rate: Rate) -> float:
    return math.log(uses_per_value(rate))


def _can_be_sent(shape_hw: tuple[int, int], rate: Rate) -> bool:
    """Whether sides, of the camera too, and received samples are within the protocol's limits."""
    coded_hw = coded_shape(shape_hw, rate)
    if max(*shape_hw, *coded_hw) > MAX_SIDE_PX:
        return False
    return received_bytes(layout_for(coded_hw)) <= MAX_PAYLOAD_BYTES


def _capacity_bits(snr_db: float) -> float:
    """Shannon's capacity of a complex use."""
    return math.log2(1.0 + 10.0 ** (snr_db / 10.0))
