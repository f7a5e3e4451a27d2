import numpy as np
import pytest

from semcast.common.phy.pilots import insert_pilots, pilot_symbols, split
from semcast.common.phy.slots import SlotLayout


def test_pilots_have_unit_power_and_are_qpsk():
    pilots = pilot_symbols(SlotLayout(num_slots=9, blocks_per_slot=40))
    assert pilots.shape == (9, 40)
    np.testing.assert_allclose(np.abs(pilots), 1.0, rtol=1e-6)
    np.testing.assert_allclose(np.abs(pilots.real), np.sqrt(0.5), rtol=1e-6)


def test_pilots_are_fixed_for_all_time():
    # Both ends, of whatever version, must agree: the hash in plain integers, and its first two rows.
    def sign_pair(slot, position):
        mask = (1 << 64) - 1
        x = ((slot << 32 | position) + 0x9E3779B97F4A7C15) & mask
        x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 & mask
        x = (x ^ x >> 27) * 0x94D049BB133111EB & mask
        quadrant = (x ^ x >> 31) >> 62
        return complex(1 - 2 * (quadrant & 1), 1 - 2 * (quadrant >> 1))

    pilots = np.rint(pilot_symbols(SlotLayout(num_slots=2, blocks_per_slot=4)) * np.sqrt(2))
    np.testing.assert_array_equal(pilots, [[sign_pair(s, k) for k in range(4)] for s in range(2)])
    np.testing.assert_array_equal(
        pilots, [[-1 - 1j, 1 - 1j, 1 - 1j, 1 + 1j], [-1 - 1j, 1 + 1j, 1 - 1j, 1 - 1j]]
    )


def test_a_pilot_depends_on_slot_and_position_only():
    small = pilot_symbols(SlotLayout(num_slots=3, blocks_per_slot=5))
    large = pilot_symbols(SlotLayout(num_slots=30, blocks_per_slot=50))
    np.testing.assert_array_equal(small, large[:3, :5])


def test_pilots_are_balanced_and_uncorrelated_between_slots():
    pilots = pilot_symbols(SlotLayout(num_slots=50, blocks_per_slot=64))
    assert abs(pilots.mean()) < 4 / np.sqrt(pilots.size)
    correlation = np.abs(pilots @ pilots.conj().T) / 64
    np.fill_diagonal(correlation, 0)
    assert correlation.max() < 0.6


def test_split_undoes_insert(rng):
    data = (rng.standard_normal((4, 94)) + 1j * rng.standard_normal((4, 94))).astype(np.complex64)
    slots = insert_pilots(data)
    assert slots.shape == (4, 96)
    pilots, back = split(slots)
    np.testing.assert_array_equal(back, data)
    np.testing.assert_array_equal(pilots, pilot_symbols(SlotLayout(num_slots=4, blocks_per_slot=2)))


def test_bad_widths_are_named():
    with pytest.raises(
        ValueError, match=r"data must have shape \(slots >= 1, multiple of 47\), got \(2, 48\)"
    ):
        insert_pilots(np.zeros((2, 48), np.complex64))
    with pytest.raises(
        ValueError, match=r"slots must have shape \(slots >= 1, multiple of 48\), got \(2, 47\)"
    ):
        split(np.zeros((2, 47), np.complex64))
    with pytest.raises(ValueError, match=r"data must have shape \(slots, symbols\), got \(94,\)"):
        insert_pilots(np.zeros(94, np.complex64))
    with pytest.raises(ValueError, match=r"slots must have shape \(slots, uses\), got \(96,\)"):
        split(np.zeros(96, np.complex64))
