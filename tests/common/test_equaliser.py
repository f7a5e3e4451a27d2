import math

import numpy as np
import pytest

from semcast.common.codec import LOST_SLOT_SNR_DB
from semcast.common.phy.equaliser import (
    NOMINAL_SNR_DB,
    ChannelEstimate,
    ChannelKnowledge,
    equalise,
    estimate_channel,
)
from semcast.common.phy.pilots import insert_pilots, pilot_symbols, split
from semcast.common.phy.qam import indices_to_symbols
from semcast.common.phy.slots import SlotLayout, layout_for


def make_frame(rng, shape_hw, snr_db, h=1.0, noise_scale=1.0):
    """Return data symbols and received slots; gain and noise scale are per slot or common."""
    layout = layout_for(shape_hw)
    data = indices_to_symbols(rng.integers(0, 16, (layout.num_slots, layout.data_per_slot)).astype(np.uint8))
    slots = insert_pilots(data)
    noise = rng.standard_normal((*slots.shape, 2)) @ np.array([1, 1j]) * math.sqrt(0.5 * 10 ** (-snr_db / 10))
    h = np.broadcast_to(np.asarray(h), (layout.num_slots,))
    scale = np.sqrt(np.broadcast_to(np.asarray(noise_scale, float), (layout.num_slots,)))
    return data, (h[:, None] * slots + scale[:, None] * noise).astype(np.complex64)


def test_a_clean_channel_is_inverted(rng):
    h = np.exp(1j * rng.uniform(0, 6.28, 4)) * rng.uniform(0.5, 2, 4)
    data, slots = make_frame(rng, (64, 64), 200.0, h)
    out = equalise(slots, (64, 64), "16qam")
    np.testing.assert_allclose(out.received.symbols, data, atol=1e-4)
    np.testing.assert_allclose(out.channel.h, h, atol=1e-5)
    assert out.received.symbols.dtype == np.complex64
    assert out.received.effective_snr_db.dtype == np.float32


def test_noise_and_snr_estimates_are_unbiased(rng):
    noise, snr, gain = [], [], []
    for _ in range(60):
        _, slots = make_frame(rng, (96, 160), 6.0, h=0.8j)
        channel = estimate_channel(split(slots)[0])
        noise.append(channel.noise_floor)
        snr.append(channel.snr_db)
        gain.append(channel.h.mean())
    # 6 slots of 10 pilots: 54 complex degrees of freedom a frame.
    sigma = 10**-0.6 / math.sqrt(54 * 60)
    assert abs(np.mean(noise) - 10**-0.6) < 4 * sigma
    assert abs(np.mean(gain) - 0.8j) < 4 * math.sqrt(10**-0.6 / 3600)
    assert np.mean(snr) == pytest.approx(6.0 + 20 * math.log10(0.8), abs=0.3)


@pytest.mark.parametrize("snr_db", [0.0, 6.0, 12.0])
def test_effective_snr_is_what_the_decoder_gets(snr_db, rng):
    stated, true = [], []
    for _ in range(20):
        data, slots = make_frame(rng, (128, 320), snr_db)
        received = equalise(slots, (128, 320), "16qam").received
        ratio = 10 ** (received.effective_snr_db / 10)
        unbiased = received.symbols * ((1 + ratio) / ratio)[:, None]
        stated.append(np.mean(1 / ratio))
        true.append(np.mean(np.abs(unbiased - data) ** 2))
    assert 10 * math.log10(np.mean(stated) / np.mean(true)) == pytest.approx(0.0, abs=0.12)
    # The gain was estimated from 20 pilots: its error adds 1/20 of the noise, and dividing by it as much
    # again over the SNR.
    loss_db = 10 * math.log10(1.05 * (1 + 0.05 / 10 ** (snr_db / 10)))
    assert -10 * math.log10(np.mean(true)) == pytest.approx(snr_db - loss_db, abs=0.15)


def test_mmse_output_is_shrunk_by_the_stated_snr(rng):
    knowledge = ChannelKnowledge(h=np.ones(16, np.complex64), noise_var=np.full(16, 0.5, np.float32))
    data, slots = make_frame(rng, (256, 640), 10 * math.log10(2))
    for known, expected in ((knowledge, 2 / 3), (None, None)):
        received = equalise(slots, (256, 640), "16qam", knowledge=known).received
        ratio = 10 ** (received.effective_snr_db.astype(float) / 10)
        shrink = np.sum(np.conj(data) * received.symbols, axis=1).real / np.sum(np.abs(data) ** 2, axis=1)
        if expected is not None:
            np.testing.assert_allclose(ratio / (1 + ratio), expected, rtol=1e-5)
        # Per slot the estimated gain is off by a few percent, which the shrinkage can't know.
        assert np.mean(shrink / (ratio / (1 + ratio))) == pytest.approx(1.0, abs=0.01 if known else 0.08)


def test_a_burst_keeps_its_own_noise_and_leaves_the_floor_alone(rng):
    scale = np.ones(16)
    scale[4:8] = 100.0
    _, slots = make_frame(rng, (256, 640), 10.0, noise_scale=scale)
    channel = estimate_channel(split(slots)[0])
    assert channel.noise_floor == pytest.approx(0.1, rel=0.2)
    np.testing.assert_allclose(channel.noise_var[scale == 1], channel.noise_floor, rtol=1e-6)
    assert (channel.noise_var[scale > 1] > 5.0).all()
    assert channel.snr_db == pytest.approx(10.0, abs=1.0)


def test_bursts_in_most_slots_still_leave_the_quiet_floor(rng):
    scale = np.full(16, 100.0)
    scale[:6] = 1.0
    _, slots = make_frame(rng, (256, 640), 10.0, noise_scale=scale)
    assert estimate_channel(split(slots)[0]).noise_floor == pytest.approx(0.1, rel=0.3)


@pytest.mark.parametrize("num_quiet", [1, 2, 3])
@pytest.mark.parametrize("snr_db", [2.0, 10.0])
def test_a_few_quiet_slots_are_enough_to_tell_the_links_own_snr(snr_db, num_quiet, rng):
    scale = np.full(16, 100.0)
    scale[rng.permutation(16)[:num_quiet]] = 1.0
    channels = [
        estimate_channel(split(make_frame(rng, (256, 320), snr_db, noise_scale=scale)[1])[0])
        for _ in range(20)
    ]
    noise_var = 10 ** (-snr_db / 10)
    assert np.mean([channel.snr_db for channel in channels]) == pytest.approx(snr_db, abs=1.5)
    assert np.mean([channel.noise_floor for channel in channels]) == pytest.approx(noise_var, rel=0.2)
    hit = np.array([channel.noise_var[scale > 1] for channel in channels])
    assert hit.mean() == pytest.approx(100.0 * noise_var, rel=0.2)


def test_a_frame_hit_in_all_slots_has_the_bursts_noise_as_floor(rng):
    _, slots = make_frame(rng, (256, 640), 10.0, noise_scale=100.0)
    assert estimate_channel(split(slots)[0]).noise_floor == pytest.approx(10.0, rel=0.2)


def test_lost_slots_come_back_as_zeros_at_the_lowest_snr(rng):
    data, slots = make_frame(rng, (64, 160), 20.0)
    lost = np.array([False, True, False, False])
    slots[2] = 0  # lost and nobody says so
    slots[3, 77] = np.nan
    received = equalise(slots, (64, 160), "16qam", slot_lost=lost).received
    assert not received.symbols[1:].any()
    np.testing.assert_array_equal(received.effective_snr_db[1:], LOST_SLOT_SNR_DB)
    np.testing.assert_allclose(received.symbols[0], data[0], atol=0.5)


def test_noise_without_signal_is_found_out(rng):
    h = np.array([1, 1, 0, 1, 1, 1.0])
    _, slots = make_frame(rng, (96, 640), 10.0, h=h)
    effective = equalise(slots, (96, 640), "16qam").received.effective_snr_db
    assert effective[2] < -8.0
    assert (np.delete(effective, 2) > 8.0).all()


def test_a_frame_of_which_nothing_arrived_is_all_zero():
    out = equalise(np.zeros((2, 96), np.complex64), (32, 32), "analog", slot_lost=np.ones(2, bool))
    assert out.snr_db == LOST_SLOT_SNR_DB
    assert not out.received.symbols.any()
    assert out.received.modulation == "analog"


def test_one_pilot_a_slot_takes_the_noise_from_neighbouring_slots(rng):
    noise = [estimate_channel(split(make_frame(rng, (320, 16), 5.0)[1])[0]).noise_floor for _ in range(100)]
    assert np.mean(noise) == pytest.approx(10**-0.5, rel=0.12)


def test_a_single_pilot_gives_the_nominal_snr(rng):
    _, slots = make_frame(rng, (16, 16), 30.0)
    out = equalise(slots, (16, 16), "16qam")
    # The gain's own error, half of the noise, is in the effective SNR.
    expected = 10 * math.log10((1 + 10 ** (NOMINAL_SNR_DB / 10)) / 2)
    assert out.received.effective_snr_db[0] == pytest.approx(expected, abs=1e-3)


def test_perfect_knowledge_is_used_as_it_is(rng):
    h = np.array([1.0, 0.5j], np.complex64)
    _, slots = make_frame(rng, (32, 64), 10.0, h=h)
    knowledge = ChannelKnowledge(h=h, noise_var=np.full(2, 0.1, np.float32))
    out = equalise(slots, (32, 64), "16qam", knowledge=knowledge)
    np.testing.assert_allclose(out.received.effective_snr_db, [10.0, 10 - 20 * math.log10(2)], atol=1e-4)
    assert out.snr_db == pytest.approx(10 * math.log10((1 + 0.25) / 2 / 0.1), abs=1e-4)


def test_the_links_snr_by_hand():
    # Powers 1.0 and 0.25, of which a fifth of the noise is the gain's own error; the quiet slot counts twice.
    channel = ChannelEstimate(
        h=np.array([1.0, 0.5j, 9.0], np.complex64),
        noise_var=np.array([0.1, 0.2, 1.0], np.float32),
        noise_floor=0.1,
        num_pilots=5,
        arrived=np.array([True, True, False]),
    )
    power = (2 * (1.0 - 0.02) + (0.25 - 0.04)) / 3
    assert channel.snr_db == pytest.approx(10 * math.log10(power / 0.1), abs=1e-5)
    np.testing.assert_allclose(channel.effective_noise_var, [0.12, 0.24, 1.2], rtol=1e-6)


def test_noise_by_hand():
    # With one pilot a slot, half the mean squared difference of neighbouring gains 1, 1.4, 1.
    gains = np.array([1.0, 1.4, 1.0])[:, None]
    pilots = pilot_symbols(SlotLayout(num_slots=3, blocks_per_slot=1))
    channel = estimate_channel((gains * pilots).astype(np.complex64))
    np.testing.assert_allclose(channel.noise_var, 0.5 * 0.4**2, rtol=1e-5)
    # With two, what their mean does not explain: 0.2 to either side, over one degree of freedom.
    pilots = pilot_symbols(SlotLayout(num_slots=1, blocks_per_slot=2))
    channel = estimate_channel((np.array([[1.2, 0.8]]) * pilots).astype(np.complex64))
    assert channel.h[0] == pytest.approx(1.0, abs=1e-6)
    assert channel.noise_var[0] == pytest.approx(2 * 0.2**2, rel=1e-5)


def test_a_link_without_noise_has_a_thousand_millionth_of_its_power_as_noise():
    pilots = pilot_symbols(SlotLayout(num_slots=2, blocks_per_slot=1)).astype(np.complex128)
    channel = estimate_channel(2.0 * pilots)
    np.testing.assert_allclose(channel.noise_var, 4e-9, rtol=1e-6)
    assert channel.noise_floor == pytest.approx(4e-9)


def test_wrong_sizes_are_named():
    with pytest.raises(ValueError, match=r"slots_rx must have shape \(2 96\), got \(2, 48\)"):
        equalise(np.zeros((2, 48), np.complex64), (32, 32), "16qam")
    with pytest.raises(ValueError, match=r"slot_lost must have shape \(2\), got \(3,\)"):
        equalise(np.zeros((2, 96), np.complex64), (32, 32), "16qam", slot_lost=np.zeros(3, bool))
