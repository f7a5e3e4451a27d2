import hashlib
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semcast.common.phy import ldpc
from semcast.common.phy.hashing import hash_words
from semcast.common.phy.ldpc_graph import base_graph, lifting_set, plan_blocks
from semcast.common.phy.qam import bits_to_indices, indices_to_symbols, soft_demap


def parity_matrix(graph):
    """Expand a lifted base graph to its dense parity-check matrix, written independently of the encoder."""
    z = graph.lifting
    matrix = np.zeros((len(graph.rows) * z, graph.num_columns * z), dtype=np.uint8)
    for r, row in enumerate(graph.rows):
        for column, shift in row:
            block = np.roll(np.eye(z, dtype=np.uint8), shift, axis=1)
            matrix[r * z : (r + 1) * z, column * z : (column + 1) * z] ^= block
    return matrix


def test_base_graphs_have_the_published_sizes():
    # TS 38.212: 316 and 197 edges; column 0 of graph 1 is in row 0 with shift 250 in set 0.
    first, second = base_graph(1, 256), base_graph(2, 256)
    assert (len(first.rows), first.num_columns, sum(map(len, first.rows))) == (46, 68, 316)
    assert (len(second.rows), second.num_columns, sum(map(len, second.rows))) == (42, 52, 197)
    assert first.rows[0][0] == (0, 250)


@pytest.mark.parametrize(("lifting", "expected"), [(2, 0), (384, 1), (320, 2), (352, 5), (15, 7), (208, 6)])
def test_lifting_sets(lifting, expected):
    assert lifting_set(lifting) == expected


@pytest.mark.parametrize(
    ("num_info", "num_sent", "columns"),
    [
        (292, 300, 10),
        (293, 300, 22),
        (670, 1000, 10),
        (671, 1000, 22),
        (3824, 7648, 10),
        (3825, 7650, 22),
        (4000, 16000, 10),
        (4000, 15999, 22),
    ],
)
def test_the_base_graph_is_that_of_the_standard(num_info, num_sent, columns):
    # TS 38.212, 7.2.2: graph 2 up to 292 bits, up to 3824 at a rate of 0.67 or less, and up to a rate of 1/4.
    assert plan_blocks(num_info, num_sent).graph.num_info_columns == columns


@pytest.mark.parametrize(
    ("num_info", "num_sent", "num_blocks"),
    [(8448, 10000, 1), (8449, 10000, 2), (3840, 16000, 1), (3841, 16000, 2)],
)
def test_a_block_is_as_long_as_the_standard_allows(num_info, num_sent, num_blocks):
    assert plan_blocks(num_info, num_sent).num_blocks == num_blocks


@pytest.mark.parametrize(
    ("num_info", "lifting"), [(192, 32), (193, 26), (560, 72), (561, 64), (640, 72), (641, 72)]
)
def test_lifting_sizes_of_the_second_graph(num_info, lifting):
    # K_b is 6, 8, 9 or 10: 193 / 8 = 24.1, and the next size is 26.
    assert plan_blocks(num_info, 2 * num_info).graph.lifting == lifting


@pytest.mark.parametrize(("num_info", "num_sent"), [(60, 200), (250, 640), (600, 900), (900, 1400)])
def test_code_words_satisfy_every_check(num_info, num_sent, rng):
    plan = plan_blocks(num_info, num_sent)
    bits = rng.integers(0, 2, plan.num_info).astype(np.uint8)
    word = ldpc.encode_words(plan, bits).reshape(-1, plan.num_blocks)
    assert not ((parity_matrix(plan.graph).astype(int) @ word) % 2).any()
    np.testing.assert_array_equal(word[: plan.info_per_block, 0], bits[: plan.info_per_block])


@pytest.mark.parametrize(
    ("num_info", "num_sent", "digest"),
    [
        (40, 150, "90833fac579e6a43"),
        (100, 200, "f41974e22d09e658"),
        (250, 800, "f8a03f746c49bb17"),
        (600, 1300, "86eedc06ffc68f77"),
        (1000, 1500, "60a5aa3e415f5697"),
        (3000, 9000, "9ac4c4644a1cdac8"),
        (3824, 7000, "ddd8088648357759"),
        (5000, 6000, "777746335be44efa"),
        (8021, 16043, "ab17d972924b663a"),
        (8448, 16896, "6d580b9533d53b9c"),
    ],
)
def test_sent_bits_are_those_of_an_independent_encoder(num_info, num_sent, digest):
    # Digests made once with LDPC5GEncoder of sionna-no-rt 2.2.0: shifts, fillers and rate matching agree.
    bits = (hash_words(num_info, 9) >> np.uint64(63)).astype(np.uint8)
    sent = ldpc.encode(plan_blocks(num_info, num_sent), bits)
    assert hashlib.sha256(np.packbits(sent).tobytes()).hexdigest()[:16] == digest


def test_both_base_graphs_and_every_lifting_set_encode_to_code_words(rng):
    # The core parity columns carry set-dependent shifts: each set must be solvable.
    for number, num_info in ((1, 22), (2, 10)):
        for lifting in (2, 3, 5, 7, 9, 11, 13, 15):
            graph = base_graph(number, lifting)
            word = np.zeros((graph.num_columns, lifting, 1), dtype=np.uint8)
            word[:num_info] = rng.integers(0, 2, (num_info, lifting, 1))
            ldpc._solve_core(graph, word)
            checks = parity_matrix(graph)[: 4 * lifting].astype(int)
            assert not ((checks @ word.reshape(-1)) % 2).any()


@settings(max_examples=25, deadline=None)
@given(st.integers(16, 3000), st.floats(1.2, 7.0), st.integers(0, 99))
def test_any_size_decodes_without_noise_and_is_filled_exactly(num_info, expansion, seed):
    num_sent = math.ceil(num_info * expansion)
    plan = plan_blocks(num_info, num_sent)
    bits = np.random.default_rng(seed).integers(0, 2, plan.num_info).astype(np.uint8)
    sent = ldpc.encode(plan, bits)
    assert sent.shape == (num_sent,)
    decoded = ldpc.decode(plan, (4.0 - 8.0 * sent).astype(np.float32))
    np.testing.assert_array_equal(decoded, bits)


def through_16qam(plan, snr_db, rng):
    bits = rng.integers(0, 2, plan.num_info).astype(np.uint8)
    order = rng.permutation(plan.num_sent)
    symbols = indices_to_symbols(bits_to_indices(ldpc.encode(plan, bits)[order]))
    noise = rng.standard_normal((symbols.size, 2)) @ np.array([1, 1j]) * math.sqrt(0.5 * 10 ** (-snr_db / 10))
    llr = np.empty(plan.num_sent, np.float32)
    llr[order] = soft_demap((symbols + noise).astype(np.complex64), 10 ** (-snr_db / 10))
    return bits, ldpc.decode(plan, llr)


def test_waterfall_of_rate_half_16qam(rng):
    # The BICM limit is 5.28 dB; published 5G curves of this length fall between 5.9 and 6.3 dB.
    plan = plan_blocks(4 * 8000, 8 * 8000)
    assert plan.num_blocks == 4
    bits, decoded = through_16qam(plan, 6.1, rng)
    np.testing.assert_array_equal(decoded, bits)
    bits, decoded = through_16qam(plan, 5.2, rng)
    assert (decoded != bits).reshape(plan.num_blocks, -1).any(axis=1).all()


def test_erasures_are_filled_in_up_to_the_rate(rng):
    plan = plan_blocks(8000, 16000)
    bits = rng.integers(0, 2, plan.num_info).astype(np.uint8)
    llr = (20.0 - 40.0 * ldpc.encode(plan, bits)).astype(np.float32)
    llr[rng.permutation(plan.num_sent)[: int(0.4 * plan.num_sent)]] = 0
    np.testing.assert_array_equal(ldpc.decode(plan, llr), bits)
    llr[rng.permutation(plan.num_sent)[: int(0.5 * plan.num_sent)]] = 0
    assert (ldpc.decode(plan, llr) != bits).any()


def test_a_good_block_is_not_held_up_by_a_bad_one(rng):
    plan = plan_blocks(2 * 8000, 4 * 8000)
    bits = rng.integers(0, 2, plan.num_info).astype(np.uint8)
    llr = (8.0 - 16.0 * ldpc.encode(plan, bits)).astype(np.float32)
    llr[16000:] *= rng.choice([-1, 1], 16000)
    decoded = ldpc.decode(plan, llr, max_iterations=5)
    np.testing.assert_array_equal(decoded[:8000], bits[:8000])
    assert (decoded[8000:] != bits[8000:]).any()


def test_one_iteration_is_allowed_and_tells_what_it_got_to(rng):
    plan = plan_blocks(1000, 2000)
    bits = np.ones(plan.num_info, np.uint8)
    llr = (8.0 - 16.0 * ldpc.encode(plan, bits)).astype(np.float32)
    assert ldpc.decode(plan, llr, max_iterations=1).all()
    llr[rng.permutation(plan.num_sent)[:160]] *= -1.0
    wrong = 1 - ldpc.decode(plan, llr, max_iterations=1).astype(int)
    assert set(wrong.tolist()) == {0, 1}
    assert wrong.mean() < 0.3


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="num_info must be at least 16, got 3"):
        plan_blocks(3, 100)
    with pytest.raises(ValueError, match="num_sent must be above num_info, got 100 and 100"):
        plan_blocks(100, 100)
    with pytest.raises(ValueError, match="base graph must be 1 or 2, got 3"):
        base_graph(3, 8)
    with pytest.raises(ValueError, match=r"lifting must be .* got 17"):
        base_graph(1, 17)
    plan = plan_blocks(100, 200)
    with pytest.raises(ValueError, match=r"bits must have shape \(100\), got \(99,\)"):
        ldpc.encode(plan, np.zeros(99, np.uint8))
    with pytest.raises(ValueError, match="bits must be 0 or 1, got 2"):
        ldpc.encode(plan, np.full(100, 2, np.uint8))
    with pytest.raises(ValueError, match=r"llr must have shape \(200\), got \(10,\)"):
        ldpc.decode(plan, np.zeros(10, np.float32))
    with pytest.raises(ValueError, match="max_iterations must be at least 1, got 0"):
        ldpc.decode(plan, np.zeros(200, np.float32), 0)
