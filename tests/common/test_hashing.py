import numpy as np

from semcast.common.phy.hashing import hash_words, hashed_qpsk


def test_words_are_those_of_splitmix64():
    # The generator's first three numbers from seed 0.
    np.testing.assert_array_equal(
        hash_words(3, 0), np.array([0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F], np.uint64)
    )


def test_words_of_two_keys_have_nothing_in_common():
    assert not set(hash_words(1000, 1).tolist()) & set(hash_words(1000, 2).tolist())


def test_the_two_highest_bits_choose_the_point():
    words = np.array([0, 1, 2, 3], np.uint64) << np.uint64(62)
    points = hashed_qpsk(words)
    assert points.dtype == np.complex64
    np.testing.assert_allclose(points * np.sqrt(2.0), [1 + 1j, -1 + 1j, 1 - 1j, -1 - 1j], rtol=1e-6)
