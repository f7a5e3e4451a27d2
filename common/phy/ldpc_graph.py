"""5G NR LDPC codes: base graphs, lifting, segmentation, rate matching (3GPP TS 38.212, 5.2.2, 5.3.2, 5.4.2).

``nr_base_graph_1.csv`` and ``nr_base_graph_2.csv`` hold Tables 5.3.2-2 and 5.3.2-3: row, column and the shift
of each of the eight lifting sets. Two things are simpler than in NR: code blocks carry no CRC of their own
(the payload carries one, the parity checks tell which block failed), and there is one redundancy version.
"""

import csv
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray

#: Lifting sizes are ``a * 2**j`` up to 384 with these ``a``; the position is the lifting set.
_LIFTING_BASES = (2, 3, 5, 7, 9, 11, 13, 15)
_MAX_LIFTING = 384
_NUM_ROWS = {1: 46, 2: 42}
_NUM_INFO_COLUMNS = {1: 22, 2: 10}
_MAX_BLOCK_BITS = {1: 8448, 2: 3840}
#: The first two columns are never sent.
PUNCTURED_COLUMNS = 2
CORE_ROWS = 4


@dataclass(frozen=True)
class BaseGraph:
    """A lifted base graph; row r, column c and shift s mean ``x[c][(k + s) % lifting]`` in check k of row r.

    Attributes:
        rows: Per base row, its ``(column, shift)`` edges in ascending column order.
        lifting: Size of each circulant.
        num_info_columns: Columns that carry information and filler bits.
    """

    rows: tuple[tuple[tuple[int, int], ...], ...]
    lifting: int
    num_info_columns: int

    @property
    def num_columns(self) -> int:
        """Information and parity columns."""
        return self.num_info_columns + len(self.rows)


def lifting_set(lifting: int) -> int:
    """Return the index of the lifting set that contains a size.

    Raises:
        ValueError: The size is not in TS 38.212 Table 5.3.2-1.
    """
    odd, doublings = lifting, 0
    while odd > 0 and odd % 2 == 0:
        odd, doublings = odd // 2, doublings + 1
    base = 2 if odd == 1 and doublings >= 1 else odd
    if not 2 <= lifting <= _MAX_LIFTING or base not in _LIFTING_BASES:
        raise ValueError(f"lifting must be a * 2**j <= 384 with a in {_LIFTING_BASES}, got {lifting}")
    return _LIFTING_BASES.index(base)


def _lifting_sizes() -> list[int]:
    sizes = {a << j for a in _LIFTING_BASES for j in range(8) if a << j <= _MAX_LIFTING}
    return sorted(sizes)


def base_graph(number: int, lifting: int) -> BaseGraph:
    """Read a base graph and reduce its shifts to one lifting size.

    Raises:
        ValueError: The number is not 1 or 2, or the lifting size doesn't exist.
    """
    if number not in _NUM_ROWS:
        raise ValueError(f"base graph must be 1 or 2, got {number}")
    column_of_set = f"set{lifting_set(lifting)}"
    text = resources.files("semcast.common.phy").joinpath(f"nr_base_graph_{number}.csv").read_text("ascii")
    rows: list[list[tuple[int, int]]] = [[] for _ in range(_NUM_ROWS[number])]
    for edge in csv.DictReader(text.splitlines()):
        rows[int(edge["row"])].append((int(edge["column"]), int(edge[column_of_set]) % lifting))
    return BaseGraph(
        rows=tuple(tuple(sorted(row)) for row in rows),
        lifting=lifting,
        num_info_columns=_NUM_INFO_COLUMNS[number],
    )


@dataclass(frozen=True)
class BlockPlan:
    """How information bits are cut into code blocks and code words into sent bits.

    Attributes:
        graph: The lifted base graph all blocks share.
        num_blocks: Code blocks.
        info_per_block: Information bits of each block; the filler behind them is zero and not sent.
        sent_per_block: ``(num_blocks,)`` sent bits of each block.
        sent_positions: ``(max(sent_per_block),)`` position of each sent bit in the code word, the two
            punctured columns included in the count, fillers skipped, wrapping round when bits repeat.
    """

    graph: BaseGraph
    num_blocks: int
    info_per_block: int
    sent_per_block: NDArray[np.int64]
    sent_positions: NDArray[np.int64]

    @property
    def num_info(self) -> int:
        """Information bits of all blocks."""
        return self.num_blocks * self.info_per_block

    @property
    def num_sent(self) -> int:
        """Sent bits of all blocks."""
        return int(self.sent_per_block.sum())


def _choose_graph(num_info: int, rate: float) -> int:
    """Return the base graph of TS 38.212, 7.2.2."""
    return 2 if num_info <= 292 or (num_info <= 3824 and rate <= 0.67) or rate <= 0.25 else 1


def _info_columns(graph_number: int, num_info: int) -> int:
    """Return K_b, the columns that decide the lifting size."""
    if graph_number == 1:
        return 22
    return 10 if num_info > 640 else 9 if num_info > 560 else 8 if num_info > 192 else 6


def plan_blocks(num_info: int, num_sent: int) -> BlockPlan:
    """Plan a code for a number of channel bits.

    Args:
        num_info: Information bits wanted, at least 16; the plan has as many or up to ``num_blocks - 1`` less,
            so that all blocks are equally long.
        num_sent: Channel bits to fill exactly.

    Raises:
        ValueError: There are too few information bits, or not more channel bits than information bits.
    """
    if num_info < 16:
        raise ValueError(f"num_info must be at least 16, got {num_info}")
    if num_sent <= num_info:
        raise ValueError(f"num_sent must be above num_info, got {num_sent} and {num_info}")
    number = _choose_graph(num_info, num_info / num_sent)
    num_blocks = -(-num_info // _MAX_BLOCK_BITS[number])
    info_per_block = num_info // num_blocks
    needed = info_per_block / _info_columns(number, num_info)
    graph = base_graph(number, next(size for size in _lifting_sizes() if size >= needed))
    z = graph.lifting
    positions = np.arange(PUNCTURED_COLUMNS * z, graph.num_columns * z)
    filler = (positions >= info_per_block) & (positions < graph.num_info_columns * z)
    positions = positions[~filler]
    sent = np.full(num_blocks, num_sent // num_blocks, dtype=np.int64)
    sent[: num_sent % num_blocks] += 1
    return BlockPlan(
        graph=graph,
        num_blocks=num_blocks,
        info_per_block=info_per_block,
        sent_per_block=sent,
        sent_positions=np.resize(positions, int(sent.max())),
    )
