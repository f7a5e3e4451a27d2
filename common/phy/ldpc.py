"""LDPC encoder and decoder, vectorised over code blocks.

Arrays are laid out ``(column, lifting, block)``: a circulant is then a cyclic shift of contiguous memory, and
one numpy call serves all blocks of an image.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.ldpc_graph import CORE_ROWS, BaseGraph, BlockPlan
from semcast.common.shapes import check_shape

#: Bounds of ``|tanh(LLR / 2)|``: a product can be divided by each of its factors, and no message is infinite.
_SMALLEST, _LARGEST = np.float32(1e-6), np.float32(1.0 - 2.0**-23)
#: LLR of a filler bit, which is known to be zero.
_KNOWN_ZERO = np.float32(1e4)


def _xor_shifted(target: NDArray[np.uint8], source: NDArray[np.uint8], shift: int) -> None:
    """``target[k] ^= source[(k + shift) % Z]`` along the first axis."""
    size = target.shape[0]
    target[: size - shift] ^= source[shift:]
    if shift:
        target[size - shift :] ^= source[:shift]


def _solve_core(graph: BaseGraph, word: NDArray[np.uint8]) -> None:
    """Fill the four core parity columns of ``word`` in place.

    In the sum of the four core rows every parity column but the first cancels, and so do two of the three
    shifts of the first; what is left gives the first column, and the rest follows row by row.
    """
    z, first = graph.lifting, graph.num_info_columns
    core = set(range(first, first + CORE_ROWS))
    sums = np.zeros((CORE_ROWS, *word.shape[1:]), dtype=np.uint8)
    remaining: set[int] = set()
    for r in range(CORE_ROWS):
        for column, shift in graph.rows[r]:
            if column < first:
                _xor_shifted(sums[r], word[column], shift)
            elif column == first:
                remaining ^= {shift}
    (shift,) = remaining
    _xor_shifted(word[first], np.bitwise_xor.reduce(sums, axis=0), (z - shift) % z)
    known = {first}
    while known < core:
        for r in range(CORE_ROWS):
            unknown = [(c, s) for c, s in graph.rows[r] if c in core and c not in known]
            if len(unknown) != 1:
                continue
            (column, shift) = unknown[0]
            for other, other_shift in graph.rows[r]:
                if other in known:
                    _xor_shifted(sums[r], word[other], other_shift)
            _xor_shifted(word[column], sums[r], (z - shift) % z)
            known.add(column)


def encode(plan: BlockPlan, bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Encode information bits and pick those to send.

    Args:
        plan: The code.
        bits: ``(plan.num_info,)`` uint8 of 0 and 1.

    Returns:
        ``(plan.num_sent,)`` uint8, block after block.
    """
    word = encode_words(plan, bits)
    sent = word.reshape(-1, plan.num_blocks)[plan.sent_positions]
    return np.concatenate([sent[:count, k] for k, count in enumerate(plan.sent_per_block)])


def encode_words(plan: BlockPlan, bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return whole code words ``(num_columns, lifting, num_blocks)``, punctured and filler bits included.

    Raises:
        ValueError: There are not exactly ``plan.num_info`` bits of 0 and 1.
    """
    check_shape(bits, f"{plan.num_info}", "bits")
    if bits.size and int(bits.max()) > 1:
        raise ValueError(f"bits must be 0 or 1, got {int(bits.max())}")
    graph = plan.graph
    word = np.zeros((graph.num_columns, graph.lifting, plan.num_blocks), dtype=np.uint8)
    word.reshape(-1, plan.num_blocks)[: plan.info_per_block] = bits.reshape(plan.num_blocks, -1).T
    _solve_core(graph, word)
    for r in range(CORE_ROWS, len(graph.rows)):
        parity = graph.num_info_columns + r
        for column, shift in graph.rows[r]:
            if column != parity:
                _xor_shifted(word[parity], word[column], shift)
    return word


def _gather(target: NDArray[np.float32], source: NDArray[np.float32], shift: int) -> None:
    """``target[k] = source[(k + shift) % Z]``."""
    size = target.shape[0]
    target[: size - shift] = source[shift:]
    target[size - shift :] = source[:shift]


def _scatter(target: NDArray[np.float32], source: NDArray[np.float32], shift: int) -> None:
    """``target[(k + shift) % Z] = source[k]``."""
    size = target.shape[0]
    target[shift:] = source[: size - shift]
    target[:shift] = source[size - shift :]


def _update_row(
    belief: NDArray[np.float32], messages: NDArray[np.float32], row: tuple[tuple[int, int], ...]
) -> None:
    """Process one base row in place: the layer of a layered sum-product decoder.

    ``tanh(out_e / 2)`` is the product of ``tanh(in_d / 2)`` over the other edges ``d`` of the check.

    Args:
        belief: ``(num_columns, Z, B)`` a-posteriori LLRs.
        messages: ``(degree, Z, B)`` what the row told each of its columns last time.
        row: Its edges.
    """
    inputs = np.empty_like(messages)
    for edge, (column, shift) in enumerate(row):
        _gather(inputs[edge], belief[column], shift)
    inputs -= messages
    half = np.tanh(np.float32(0.5) * inputs)
    np.copyto(half, _SMALLEST, where=np.abs(half) < _SMALLEST)
    np.divide(np.multiply.reduce(half, axis=0), half, out=half)
    np.clip(half, -_LARGEST, _LARGEST, out=half)
    np.log((np.float32(1.0) + half) / (np.float32(1.0) - half), out=messages)
    inputs += messages
    for edge, (column, shift) in enumerate(row):
        _scatter(belief[column], inputs[edge], shift)


def _failed(belief: NDArray[np.float32], rows: tuple[tuple[tuple[int, int], ...], ...]) -> NDArray[np.bool_]:
    """Return ``(B,)`` flags of blocks with an unsatisfied check; undecided bits read as 0, a CRC decides."""
    hard = (belief < 0).view(np.uint8)
    failed = np.zeros(belief.shape[1:], dtype=np.uint8)
    syndrome = np.empty_like(failed)
    for row in rows:
        syndrome[:] = 0
        for column, shift in row:
            _xor_shifted(syndrome, hard[column], shift)
        failed |= syndrome
    return np.asarray(failed.any(axis=0), dtype=np.bool_)


def decode(plan: BlockPlan, llr: NDArray[np.float32], max_iterations: int = 30) -> NDArray[np.uint8]:
    """Decode by layered sum-product, each block until its parity checks hold.

    Args:
        plan: The code.
        llr: ``(plan.num_sent,)`` finite LLRs ``ln P(0) / P(1)``, block after block; 0 is an erasure.
        max_iterations: Limit for blocks that don't converge.

    Returns:
        ``(plan.num_info,)`` bits; of a block that did not converge as far as the last iteration got.

    Raises:
        ValueError: The LLRs are of the wrong number or there is no iteration allowed.
    """
    check_shape(llr, f"{plan.num_sent}", "llr")
    if max_iterations < 1:
        raise ValueError(f"max_iterations must be at least 1, got {max_iterations}")
    belief, num_rows = _channel_belief(plan, llr)
    rows = plan.graph.rows[:num_rows]
    messages = [np.zeros((len(row), *belief.shape[1:]), dtype=np.float32) for row in rows]
    bits = np.empty((plan.info_per_block, plan.num_blocks), dtype=np.uint8)
    active = np.arange(plan.num_blocks)
    iteration = 0
    while active.size and iteration < max_iterations:
        iteration += 1
        for row, told in zip(rows, messages, strict=True):
            _update_row(belief, told, row)
        failed = _failed(belief, rows)
        if iteration < max_iterations and failed.all():
            continue
        done = slice(None) if iteration == max_iterations else ~failed
        flat = belief.reshape(-1, active.size)[: plan.info_per_block]
        bits[:, active[done]] = flat[:, done] < 0
        active = active[failed]
        belief = np.ascontiguousarray(belief[:, :, failed])
        messages = [np.ascontiguousarray(told[:, :, failed]) for told in messages]
    return bits.T.reshape(-1)


def _channel_belief(plan: BlockPlan, llr: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """Undo the rate matching.

    Returns:
        ``(num_columns, Z, num_blocks)`` LLRs, repeated bits added up, and how many base rows matter: a row
        whose own parity column was not sent tells nothing.
    """
    graph, z = plan.graph, plan.graph.lifting
    longest = int(plan.sent_per_block.max())
    received = np.zeros((longest, plan.num_blocks), dtype=np.float32)
    start = 0
    for k, count in enumerate(plan.sent_per_block):
        received[:count, k] = llr[start : start + count]
        start += int(count)
    period = np.unique(plan.sent_positions).size
    last_column = int(plan.sent_positions.max()) // z
    num_rows = max(CORE_ROWS, last_column + 1 - graph.num_info_columns)
    belief = np.zeros((graph.num_columns * z, plan.num_blocks), dtype=np.float32)
    for begin in range(0, longest, period):
        chunk = received[begin : begin + period]
        belief[plan.sent_positions[begin : begin + period]] += chunk
    belief[plan.info_per_block : graph.num_info_columns * z] = _KNOWN_ZERO
    used = graph.num_info_columns + num_rows
    return belief.reshape(graph.num_columns, z, plan.num_blocks)[:used].copy(), num_rows
