"""Eight-bit convolutions for an exported encoder: about twice as fast where bfloat16 is not in hardware.

Weights and activations of the network's convolutions become integers, their ranges learned from images. The
linear transform, which carries most of the picture and takes a fiftieth of the work, stays in floating point.
"""

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from semcast.common.nets.detail import allocation_for
from semcast.common.nets.onnx_encoder import INPUTS, VALUES_INPUT
from semcast.common.phy.slots import BLOCK_PX

#: Images the ranges are taken from, at most, and their longer side in pixels.
_NUM_IMAGES, _SIDE_PX = 48, 512
#: Parts of the names of convolutions that stay as they are.
_EXACT = ("/linear/", "/head/")


class _Ranges(CalibrationDataReader):  # type: ignore[misc]
    """Inputs that show which values activations take: photos under links from bad to good."""

    def __init__(
        self, path: Path, images: list[NDArray[np.uint8]], snr_range_db: tuple[float, float]
    ) -> None:
        names = {given.name for given in InferenceSession(str(path)).get_inputs()}
        self._inputs = self._all(VALUES_INPUT in names, images, snr_range_db)

    @staticmethod
    def _all(
        is_variable: bool, images: list[NDArray[np.uint8]], snr_range_db: tuple[float, float]
    ) -> Iterator[dict[str, NDArray[np.generic]]]:
        image_name, snr_name = INPUTS
        count = min(len(images), _NUM_IMAGES)
        chosen = [images[k * len(images) // count] for k in range(count)]
        for image, snr_db in zip(chosen, np.linspace(*snr_range_db, len(chosen)), strict=True):
            height, width = (min(_SIDE_PX, side) // BLOCK_PX * BLOCK_PX for side in image.shape[:2])
            pixels = np.ascontiguousarray(image[:height, :width])
            inputs: dict[str, NDArray[np.generic]] = {
                image_name: pixels[None],
                snr_name: np.array([snr_db], dtype=np.float32),
            }
            if is_variable:
                values = allocation_for(pixels).values
                inputs[VALUES_INPUT] = values[None, None].astype(np.float32)
            yield inputs

    def get_next(self) -> dict[str, NDArray[np.generic]] | None:
        """Return the next input, None behind the last."""
        return next(self._inputs, None)


def quantise(
    path: Path,
    convolutions: list[str],
    images: list[NDArray[np.uint8]],
    snr_range_db: tuple[float, float],
) -> None:
    """Replace an exported encoder in single precision by one with eight-bit convolutions.

    Weights have seven bits, one scale for each output channel: on processors without VNNI two products of
    eight bits would overflow.

    Args:
        path: The encoder.
        convolutions: Names of its convolutions.
        images: Photos; 48 of them, evenly chosen, are used.
        snr_range_db: SNRs at which values arrive.
    """
    # It would warn that it was not given a graph prepared for it; this one has nothing to prepare.
    logging.disable(logging.WARNING)
    try:
        quantize_static(
            str(path),
            str(path),
            _Ranges(path, images, snr_range_db),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_quantize=[name for name in convolutions if not any(part in name for part in _EXACT)],
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finally:
        logging.disable(logging.NOTSET)
