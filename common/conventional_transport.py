"""Bytes over the data symbols of one frame: CRC, scrambling, LDPC, interleaving over the frame, QAM.

The transport block is ``length (4 bytes) | payload | CRC-32 of both (4 bytes) | zeros``. It is scrambled, so
that padding looks random and the symbols have unit power, and the coded bits are permuted over the whole
frame, so that a lost slot costs every code block a little instead of one block everything.
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy import ldpc
from semcast.common.phy.hashing import hash_words
from semcast.common.phy.ldpc_graph import BlockPlan, plan_blocks
from semcast.common.phy.qam import bits_to_indices, indices_to_symbols, soft_demap

_OVERHEAD_BYTES = 8
_MIN_INFO_BITS = 8 * _OVERHEAD_BYTES
#: LLRs beyond this carry no more information and would only slow the decoder's arithmetic down.
_LLR_LIMIT = 40.0


class Transport:
    """One modulation and code rate over a fixed number of symbols."""

    def __init__(self, num_symbols: int, bits_per_symbol: int, rate: float) -> None:
        """Plan the code.

        Raises:
            ValueError: The symbols can't carry even an empty block at this rate.
        """
        self._bits_per_symbol = bits_per_symbol
        num_sent = num_symbols * bits_per_symbol
        num_info = int(num_sent * rate)
        if num_info < _MIN_INFO_BITS:
            raise ValueError(
                f"{num_symbols} symbols must carry at least {_MIN_INFO_BITS} information bits, got {num_info}"
            )
        self._plan: BlockPlan = plan_blocks(num_info, num_sent)
        self._order = np.argsort(hash_words(num_sent, 1), kind="stable")
        self._scrambler = (hash_words(self._plan.num_info, 2) >> np.uint64(63)).astype(np.uint8)

    @property
    def capacity_bytes(self) -> int:
        """The longest payload that fits."""
        return self._plan.num_info // 8 - _OVERHEAD_BYTES

    def encode(self, payload: bytes) -> NDArray[np.complex64]:
        """Return the ``(num_symbols,)`` symbols of a payload.

        Raises:
            ValueError: The payload is longer than ``capacity_bytes``.
        """
        if len(payload) > self.capacity_bytes:
            raise ValueError(f"payload must have at most {self.capacity_bytes} bytes, got {len(payload)}")
        head = struct.pack(">I", len(payload)) + payload
        block = head + struct.pack(">I", zlib.crc32(head))
        bits = np.zeros(self._plan.num_info, dtype=np.uint8)
        content = np.unpackbits(np.frombuffer(block, dtype=np.uint8))
        bits[: content.size] = content
        coded = ldpc.encode(self._plan, bits ^ self._scrambler)
        return indices_to_symbols(
            bits_to_indices(coded[self._order], self._bits_per_symbol), self._bits_per_symbol
        )

    def decode(
        self, symbols: NDArray[np.complex64], noise_var: NDArray[np.float32], erased: NDArray[np.bool_]
    ) -> bytes | None:
        """Recover the payload.

        Args:
            symbols: ``(num_symbols,)`` unbiased symbols.
            noise_var: ``(num_symbols,)`` noise variances, above 0.
            erased: ``(num_symbols,)`` symbols of which nothing is known.

        Returns:
            The payload, or None when the CRC doesn't hold.
        """
        llr = soft_demap(symbols, noise_var, self._bits_per_symbol)
        llr[np.repeat(erased, self._bits_per_symbol)] = 0.0
        np.clip(llr, -_LLR_LIMIT, _LLR_LIMIT, out=llr)
        deinterleaved = np.empty_like(llr)
        deinterleaved[self._order] = llr
        bits = ldpc.decode(self._plan, deinterleaved)
        block = np.packbits(bits ^ self._scrambler).tobytes()
        (length,) = struct.unpack_from(">I", block)
        if length > self.capacity_bytes:
            return None
        (crc,) = struct.unpack_from(">I", block, 4 + length)
        return block[4 : 4 + length] if zlib.crc32(block[: 4 + length]) == crc else None
