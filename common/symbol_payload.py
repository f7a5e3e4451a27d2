"""Channel symbols as the bytes of a ``SymbolFrame``, and back: for the channel, and for the decoder."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import EncodedImage
from semcast.common.levels import Levels
from semcast.common.messages import IQ_BYTES, PayloadFormat, SymbolFrame
from semcast.common.phy.equaliser import Equalised, equalise
from semcast.common.phy.qam import (
    SHAPED_SPACING,
    indices_to_symbols,
    pack_indices,
    symbols_to_indices,
    unpack_indices,
)
from semcast.common.phy.slots import layout_for
from semcast.common.shapes import check_shape

#: Largest finite value a sample may have: float16 ends at 65504.
_LARGEST = 65000.0
_ON_THE_GRID = 1e-3
#: Payloads of 4-bit indices, the more frequent first, and the factor on the points of plain 16-QAM.
_SPACING: Mapping[PayloadFormat, float] = {"qam16_shaped": SHAPED_SPACING, "qam16": 1.0}


def pack_iq(samples: NDArray[np.complex64]) -> bytes:
    """Return float16 I and Q of samples of any shape, interleaved, little-endian; clipped to what fits."""
    reals = np.ascontiguousarray(samples, dtype=np.complex64).view(np.float32)
    return np.clip(reals, -_LARGEST, _LARGEST).astype("<f2").tobytes()


def unpack_iq(payload: bytes, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Return the ``shape`` complex64 samples that ``pack_iq`` packed; NaN and infinity come through.

    Raises:
        ValueError: The number of bytes doesn't fit the shape.
    """
    expected = IQ_BYTES * shape[0] * shape[1]
    if len(payload) != expected:
        raise ValueError(f"payload of {shape} samples must have {expected} bytes, got {len(payload)}")
    return np.frombuffer(payload, dtype="<f2").astype(np.float32).view(np.complex64).reshape(shape)


def pack_data_symbols(encoded: EncodedImage) -> tuple[PayloadFormat, bytes]:
    """Return format and bytes of a frame's data symbols.

    16-QAM points, plain or shaped, become 4-bit indices; anything else (analog symbols, or the other
    constellations of adaptive codecs) float16 I and Q.

    Raises:
        ValueError: The symbols don't have the shape of the image's slot grid, or are not finite.
    """
    layout = layout_for(encoded.shape_hw)
    check_shape(encoded.symbols, f"{layout.num_slots} {layout.data_per_slot}", "symbols")
    if not np.isfinite(encoded.symbols.view(np.float32)).all():
        raise ValueError("symbols must be finite")
    if encoded.modulation == "16qam":
        for payload_format, spacing in _SPACING.items():
            plain = encoded.symbols / np.float32(spacing)
            indices = symbols_to_indices(plain)
            offset = np.abs((plain - indices_to_symbols(indices)).view(np.float32)).max()
            if offset < _ON_THE_GRID:
                return payload_format, pack_indices(indices)
    return "iq16", pack_iq(encoded.symbols)


def data_symbols(frame: SymbolFrame) -> NDArray[np.complex64]:
    """Return the ``(num_slots, data_per_slot)`` data symbols of a ``tx`` frame.

    Raises:
        ValueError: It is no ``tx`` frame, or a sample is not finite.
    """
    if frame.direction != "tx":
        raise ValueError(f"frame must be tx to hold data symbols, got {frame.direction}")
    layout = frame.layout
    shape = (layout.num_slots, layout.data_per_slot)
    if frame.payload_format in _SPACING:
        points = indices_to_symbols(unpack_indices(frame.payload, shape[0] * shape[1])).reshape(shape)
        return points * np.float32(_SPACING[frame.payload_format])
    symbols = unpack_iq(frame.payload, shape)
    if not np.isfinite(symbols.view(np.float32)).all():
        raise ValueError("symbols must be finite")
    return symbols


def encoded_image(frame: SymbolFrame) -> EncodedImage:
    """Return what the codec made, of a ``tx`` frame.

    Raises:
        ValueError: See ``data_symbols``, or the levels are none.
    """
    return EncodedImage(
        shape_hw=frame.image_hw,
        symbols=data_symbols(frame),
        modulation=frame.modulation,
        levels=Levels(*frame.levels),
        allocation=frame.allocation,
    )


def slots_of(frame: SymbolFrame) -> NDArray[np.complex64]:
    """Return the ``(num_slots, uses_per_slot)`` received samples of an ``rx`` frame, pilots first.

    All zero where nothing arrived.

    Raises:
        ValueError: It is no ``rx`` frame.
    """
    if frame.direction != "rx":
        raise ValueError(f"frame must be rx to hold received samples, got {frame.direction}")
    shape = (frame.num_slots, frame.uses_per_slot)
    if frame.payload_format == "lost":
        return np.zeros(shape, dtype=np.complex64)
    return unpack_iq(frame.payload, shape)


def pack_lost(slot_lost: NDArray[np.bool_]) -> bytes:
    """Return ``(num_slots,)`` flags as one bit each, first slot highest."""
    return np.packbits(slot_lost).tobytes()


def lost_slots_of(frame: SymbolFrame) -> NDArray[np.bool_]:
    """Return the ``(num_slots,)`` slots of an ``rx`` frame of which nothing arrived."""
    bits = np.unpackbits(np.frombuffer(frame.slot_lost, dtype=np.uint8), count=frame.num_slots)
    return bits.astype(bool)


def equalise_frame(frame: SymbolFrame) -> Equalised:
    """Return what the codec decodes of an ``rx`` frame, and the receiver's estimate of the link.

    Raises:
        ValueError: It is no ``rx`` frame, or the levels are none.
    """
    return equalise(
        slots_of(frame),
        frame.image_hw,
        frame.modulation,
        slot_lost=lost_slots_of(frame),
        levels=Levels(*frame.levels),
        allocation=frame.allocation,
    )
