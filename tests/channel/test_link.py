import math
from dataclasses import replace

import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.registry import MODELS, build_channel
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import LOST_SLOT_SNR_DB, EncodedImage
from semcast.common.errors import ConfigError
from semcast.common.phy.pilots import insert_pilots
from semcast.common.phy.qam import indices_to_symbols


@pytest.fixture
def encoded(rng):
    indices = rng.integers(0, 16, (12, 47 * 20)).astype(np.uint8)
    return EncodedImage(shape_hw=(192, 320), symbols=indices_to_symbols(indices), modulation="16qam")


@pytest.fixture
def slots(encoded):
    return insert_pilots(encoded.symbols)


@pytest.mark.parametrize("snr_db", [2.0, 10.0])
def test_awgn_adds_exactly_the_noise_that_was_set(slots, snr_db):
    link = Link(ChannelSettings(snr_db=snr_db), 1)
    out = link.transmit(slots, 0.0)
    scale = np.sqrt(np.mean(np.abs(slots) ** 2))
    noise = out.slots_rx - slots / scale
    expected = 10 ** (-snr_db / 10)
    assert abs(np.mean(np.abs(noise) ** 2) - expected) < 4 * expected / math.sqrt(noise.size)
    assert out.slots_rx.dtype == np.complex64
    assert out.snr_db_set == snr_db
    assert not out.slot_lost.any()
    assert not out.frame_lost


def test_a_louder_codec_gains_nothing(slots):
    quiet = Link(ChannelSettings(), 1).transmit(slots, 0.0)
    loud = Link(ChannelSettings(), 1).transmit(7 * slots, 0.0)
    np.testing.assert_allclose(loud.slots_rx, quiet.slots_rx, atol=1e-5)
    np.testing.assert_allclose(loud.truth.h * 7, quiet.truth.h, rtol=1e-5)


@pytest.mark.parametrize("channel", MODELS)
def test_a_frame_is_the_same_after_lost_frames_and_restarts(channel, slots):
    settings = ChannelSettings(channel=channel, trace="walk")
    whole = Link(settings, 5)
    frames = [whole.transmit(slots, 0.1 * k, k) for k in range(4)]
    gaps = Link(settings, 5)
    gaps.transmit(slots, 0.0, 0)
    np.testing.assert_array_equal(gaps.transmit(slots, 0.1 * 3, 3).slots_rx, frames[3].slots_rx)
    counted = Link(settings, 5)
    again = [counted.transmit(slots, 0.1 * k) for k in range(4)]
    np.testing.assert_array_equal(again[2].slots_rx, frames[2].slots_rx)
    assert not np.array_equal(frames[1].slots_rx, frames[2].slots_rx)
    assert not np.array_equal(Link(settings, 6).transmit(slots, 0.0, 0).slots_rx, frames[0].slots_rx)


def test_fading_with_doppler_is_the_same_after_lost_frames_and_starts_with_the_link(slots):
    settings = ChannelSettings(channel="rayleigh", doppler_hz=20.0)
    whole, gaps, late = (Link(settings, 5) for _ in range(3))
    gains = [whole.transmit(slots, 0.1 * k, k).truth.h for k in range(4)]
    gaps.transmit(slots, 0.0, 0)
    np.testing.assert_array_equal(gaps.transmit(slots, 0.1 * 3, 3).truth.h, gains[3])
    assert np.abs(gains[3] - gains[0]).max() > 0.1
    # A link that comes in later counts time from there.
    np.testing.assert_allclose(np.abs(late.transmit(slots, 0.1 * 3, 3).truth.h), np.abs(gains[0]), rtol=1e-5)


@pytest.mark.parametrize("channel", ["rayleigh", "trace"])
def test_time_begins_anew_with_a_restart(channel, slots):
    settings = ChannelSettings(channel=channel, doppler_hz=20.0, trace="ramp", trace_s=1.0)
    link = Link(settings, 5)
    first, later = (link.transmit(slots, t_s) for t_s in (0.0, 0.4))
    link.restart()
    again = link.transmit(slots, 77.0)
    np.testing.assert_array_equal(again.slots_rx, first.slots_rx)
    assert not np.array_equal(later.slots_rx, first.slots_rx)


def test_rayleigh_gains_are_what_the_receiver_estimates(slots, encoded):
    link = Link(ChannelSettings(channel="rayleigh", snr_db=25.0), 2)
    truth = link.transmit(slots, 0.0, 0).truth
    estimate = link.receive(encoded, 0.0, 0).channel
    np.testing.assert_allclose(estimate.h, truth.h, atol=0.06)


def test_doppler_keeps_neighbouring_slots_alike(slots):
    slow = ChannelSettings(channel="rayleigh", doppler_hz=5.0, slot_ms=1.0)
    gains = Link(slow, 2).transmit(slots, 0.0).truth.h
    assert np.abs(np.diff(gains)).max() < 0.15
    independent = Link(ChannelSettings(channel="rayleigh"), 2).transmit(slots, 0.0).truth.h
    assert np.abs(np.diff(independent)).max() > 0.5


def test_erasure_loses_a_fifth_of_the_slots_and_says_which(slots):
    link = Link(ChannelSettings(channel="erasure"), 0)
    lost = np.array([link.transmit(slots, 0.0, k).slot_lost for k in range(400)])
    assert abs(lost.mean() - 0.2) < 4 * math.sqrt(0.16 / lost.size)
    out = link.transmit(slots, 0.0, 7)
    assert not out.slots_rx[out.slot_lost].any()
    assert (np.abs(out.slots_rx[~out.slot_lost]) > 0).all()


def test_a_burst_raises_the_noise_and_is_not_announced(slots, encoded):
    link = Link(ChannelSettings(channel="burst", snr_db=10.0, burst_noise_db=20.0), 3)
    frame_id = next(k for k in range(50) if 2 < np.sum(link.transmit(slots, 0, k).truth.noise_var > 1) < 8)
    out = link.transmit(slots, 0.0, frame_id)
    assert not out.slot_lost.any()
    hit = out.truth.noise_var > 1
    np.testing.assert_allclose(out.truth.noise_var, np.where(hit, 10.0, 0.1), rtol=1e-4)
    effective = link.carry(encoded, 0.0, frame_id).effective_snr_db
    assert effective[hit].max() < 0.0 < 8.0 < effective[~hit].min()


def test_lost_frames_have_their_rate_and_carry_nothing(slots, encoded):
    link = Link(ChannelSettings(frame_loss=0.3), 0)
    out = [link.transmit(slots, 0.0, k) for k in range(600)]
    rate = np.mean([o.frame_lost for o in out])
    assert abs(rate - 0.3) < 4 * math.sqrt(0.21 / 600)
    lost = next(k for k, o in enumerate(out) if o.frame_lost)
    assert not out[lost].slots_rx.any()
    assert out[lost].slot_lost.all()
    assert link.carry(encoded, 0.0, lost) is None


def test_frame_loss_does_not_shift_the_noise_of_the_others(slots):
    lossy = Link(ChannelSettings(frame_loss=0.3), 0)
    clean = Link(ChannelSettings(), 0)
    kept = next(k for k in range(20) if not lossy.transmit(slots, 0.0, k).frame_lost)
    np.testing.assert_array_equal(
        lossy.transmit(slots, 0.0, kept).slots_rx, clean.transmit(slots, 0.0, kept).slots_rx
    )


def test_carry_returns_symbols_and_honest_snr(encoded):
    received = Link(ChannelSettings(snr_db=12.0), 0).carry(encoded, 0.0)
    assert received.shape_hw == encoded.shape_hw
    assert received.modulation == "16qam"
    np.testing.assert_allclose(received.effective_snr_db, 12.0, atol=1.5)
    sent = Link(ChannelSettings(snr_db=12.0), 0).transmit(insert_pilots(encoded.symbols), 0.0)
    by_pilots = sent.equalise(encoded).received
    np.testing.assert_array_equal(by_pilots.symbols, received.symbols, "the truth is used where asked only")
    perfect = Link(ChannelSettings(snr_db=12.0), 0).carry(encoded, 0.0, perfect_csi=True)
    power = np.mean(np.abs(insert_pilots(encoded.symbols)) ** 2)
    np.testing.assert_allclose(perfect.effective_snr_db, 12.0 - 10 * np.log10(power), atol=1e-3)


def test_lost_slots_reach_the_decoder_as_lost(encoded):
    received = Link(ChannelSettings(channel="erasure", slot_loss=0.5), 0).carry(encoded, 0.0)
    lost = received.effective_snr_db == LOST_SLOT_SNR_DB
    assert 0 < lost.sum() < 12
    assert not received.symbols[lost].any()


def change(link, settings):
    link.switch(settings, build_channel(settings, 0))


def test_settings_change_between_frames(slots, tmp_path):
    link = Link(ChannelSettings(snr_db=10.0), 0)
    assert link.transmit(slots, 0.0).snr_db_set == 10.0
    change(link, ChannelSettings(snr_db=4.0))
    assert link.transmit(slots, 0.1).snr_db_set == 4.0
    change(link, ChannelSettings(channel="trace", snr_db=9.0, trace_end_db=1.0, trace_s=4.0))
    assert link.transmit(slots, 30.0).snr_db_set == 9.0
    assert link.transmit(slots, 32.0).snr_db_set == pytest.approx(5.0)
    missing = ChannelSettings(channel="trace", trace="file", trace_file=tmp_path / "no.csv")
    with pytest.raises(ConfigError, match="can't be read"):
        change(link, missing)
    assert link.settings.trace == "ramp"
    assert link.transmit(slots, 33.0).snr_db_set == pytest.approx(3.0)


def test_a_trace_begins_when_it_is_set_and_fading_goes_on(slots):
    ramp = ChannelSettings(channel="trace", snr_db=9.0, trace_end_db=1.0, trace_s=4.0, delay_ms=5.0)
    link = Link(ramp, 0)
    link.transmit(slots, 10.0)
    change(link, replace(ramp, delay_ms=9.0, trace_step_db=3.0))  # neither belongs to a ramp
    assert link.transmit(slots, 12.0).snr_db_set == pytest.approx(5.0)
    for changed in ({"snr_db": 7.0}, {"trace_end_db": 3.0}, {"trace_s": 2.0}, {"trace": "walk"}):
        change(link, replace(ramp, **changed))
        assert link.transmit(slots, 12.5).snr_db_set == changed.get("snr_db", 9.0)
        link.transmit(slots, 13.5)
    fading = ChannelSettings(channel="rayleigh", doppler_hz=2.0)
    one, two = Link(fading, 0), Link(fading, 0)
    for link in (one, two):
        link.transmit(slots, 0.0, 0)
    change(two, ramp)
    two.transmit(slots, 0.1, 1)
    change(two, replace(fading, snr_db=4.0))
    np.testing.assert_array_equal(two.transmit(slots, 0.2, 2).truth.h, one.transmit(slots, 0.2, 2).truth.h)


def test_frames_that_overlap_in_time_are_told_once_a_link_also_after_a_restart(slots, caplog):
    link = Link(ChannelSettings(channel="rayleigh", doppler_hz=5.0, slot_ms=8.125), 0)
    for _ in range(3):
        for k in range(4):
            link.transmit(slots, 0.05 * k, k)
        link.restart()
    assert [record.getMessage() for record in caplog.records] == [
        "a frame lasts 97.5 ms (12 slots of slot_ms 8.125) and the next began 50 ms after it: where they "
        "overlap they have the same fading"
    ]


def test_frames_one_after_the_other_and_fading_without_time_are_not_told_of(slots, caplog):
    fading = ChannelSettings(channel="rayleigh", doppler_hz=5.0, slot_ms=8.25)
    for settings, interval_s in ((fading, 0.099), (replace(fading, doppler_hz=0.0), 0.05)):
        link = Link(settings, 0)
        for k in (0, 1, 1, 2, 1):  # sent again, or late
            link.transmit(slots, interval_s * k, k)
    assert not caplog.records


def test_a_trace_starts_with_the_first_frame(slots):
    link = Link(ChannelSettings(channel="trace", snr_db=10.0, trace_end_db=0.0, trace_s=10.0), 0)
    assert link.transmit(slots, 1234.5).snr_db_set == 10.0
    assert link.transmit(slots, 1239.5).snr_db_set == pytest.approx(5.0)


def test_a_recorded_link_loses_slots_when_its_file_says_so_and_is_the_same_otherwise(slots, tmp_path):
    file = tmp_path / "trace.csv"
    recorded = ChannelSettings(channel="trace", trace="file", trace_file=file)
    file.write_text("t_s,snr_db\n50,6\n60,6\n")
    plain = Link(recorded, 0).transmit(slots, 100.0, 0)
    file.write_text("t_s,snr_db,slot_loss\n50,6,0\n51,6,0.4\n60,6,0.4\n61,6,1\n")
    link = Link(recorded, 0)
    np.testing.assert_array_equal(link.transmit(slots, 100.0, 0).slots_rx, plain.slots_rx)
    frames = [link.transmit(slots, 105.0, k) for k in range(1, 201)]
    num = 200 * len(slots)
    share = sum(frame.slot_lost.sum() for frame in frames) / num
    assert abs(share - 0.4) < 4 * math.sqrt(0.4 * 0.6 / num)
    assert not frames[0].slots_rx[frames[0].slot_lost].any()
    assert link.transmit(slots, 112.0, 201).slot_lost.all()


def test_bad_input_is_named(slots):
    link = Link(ChannelSettings(), 0)
    with pytest.raises(ValueError, match="must have power above 0"):
        link.transmit(np.zeros((2, 48), np.complex64), 0.0)
    with pytest.raises(ValueError, match="frame_id must be at least 0, got -1"):
        link.transmit(slots, 0.0, -1)
    with pytest.raises(ValueError, match="seed must be at least 0, got -3"):
        Link(ChannelSettings(), -3)
    with pytest.raises(ValueError, match=r"slots must have shape \(S U\)"):
        link.transmit(np.zeros(48, np.complex64), 0.0)
