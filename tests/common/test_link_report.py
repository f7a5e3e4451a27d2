"""The report on a link: what a steady one carries, learned from a few frames."""

import math

import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import LOST_SLOT_SNR_DB, EncodedImage
from semcast.common.conventional import ADAPTIVE_MODES, MODE_MARGIN_DB
from semcast.common.link_report import LinkReporter, SlotSnrs, reachable_snr_db, steady_snr_db
from semcast.common.phy.mutual_information import mutual_information, snr_db_that_carries
from semcast.common.phy.qam import constellation
from semcast.common.phy.slots import layout_for


def frames(*snrs):
    return [SlotSnrs(np.array(snr, float), 0) for snr in snrs]


def db(ratio):
    return 10 * math.log10(ratio)


def test_the_steady_snr_is_the_links_own_where_all_slots_are_alike():
    for bits in (2, 4, 6):
        assert steady_snr_db(frames([5, 5, 5, 5]), bits) == pytest.approx(db(5), abs=0.01)


def test_the_steady_snr_carries_what_slots_carry_less_what_one_frame_of_twenty_has_less():
    carried = mutual_information(4, np.array([3.0, 3.0, 15.0, 15.0]))
    for count, factor in ((1, 2.0), (3, 4 / 3)):
        bits = carried.mean() - 1.645 * math.sqrt(factor * carried.var() / 4)
        expected = snr_db_that_carries(4, bits) + MODE_MARGIN_DB
        assert steady_snr_db(frames(*[[3, 3, 15, 15]] * count), 4) == pytest.approx(expected)


def test_the_margin_of_the_modes_is_not_counted_twice():
    slots = np.full(32, 10.0)
    slots[::2] = 9.0  # fluctuates by far less than the modes' own margin
    mean = mutual_information(4, slots).mean()
    assert steady_snr_db(frames(slots), 4) == pytest.approx(snr_db_that_carries(4, mean))


def test_a_slot_carries_no_more_than_its_constellation_and_a_lost_one_nothing():
    assert steady_snr_db(frames([1000] * 3 + [0]), 6) > steady_snr_db(frames([1000] * 3 + [0]), 2) + 5
    assert steady_snr_db(frames([3, 3, 3, 0]), 4) < steady_snr_db(frames([3, 3, 3, 3]), 4) - 3
    assert steady_snr_db(frames([0, 0, 0, 0]), 4) <= LOST_SLOT_SNR_DB + MODE_MARGIN_DB
    assert reachable_snr_db(frames([0, 0, 0, 0])) <= LOST_SLOT_SNR_DB + MODE_MARGIN_DB


def test_no_mode_is_reached_that_its_constellation_cannot_hold():
    # A third of the slots lost: a rate of .64 would need nearly all bits of the others.
    lossy = frames([1e4, 1e4, 0] * 20)
    full = next(mode for mode in ADAPTIVE_MODES if mode.bits_per_symbol == 4 and mode.rate > 0.64)
    assert reachable_snr_db(lossy) < full.min_snr_db


HW = (512, 256)


def reports(reporter, settings, numbers, seed=0):
    layout = layout_for(HW)
    rng = np.random.default_rng(9)
    symbols = constellation()[rng.integers(0, 16, (layout.num_slots, layout.data_per_slot))]
    link = Link(settings, seed)
    encoded = EncodedImage(HW, symbols, "16qam")
    return [reporter.snr_db(link.receive(encoded, 0.1 * k, k)) for k in numbers]


def test_reports_on_a_fading_link_settle():
    fading = ChannelSettings(channel="rayleigh", snr_db=10.0)
    alone = [reports(LinkReporter("jpeg-amc"), fading, [k])[0] for k in range(40)]
    together = reports(LinkReporter("jpeg-amc"), fading, range(40))[8:]
    assert np.std(together) < 0.6 * np.std(alone)
    assert np.mean(together) > np.mean(alone)


def test_reports_on_a_steady_link_settle():
    steady = ChannelSettings(snr_db=14.0)
    alone = [reports(LinkReporter("jpeg-amc"), steady, [k])[0] for k in range(40)]
    together = reports(LinkReporter("jpeg-amc"), steady, range(40))[8:]
    assert np.std(together) < 0.6 * np.std(alone)


def test_a_link_that_changes_is_believed_at_once():
    reporter = LinkReporter("jpeg-amc")
    good, bad = ChannelSettings(snr_db=14.0), ChannelSettings(snr_db=6.0)
    before = reports(reporter, good, range(8))
    after = reports(reporter, bad, [8])
    assert before[-1] == pytest.approx(14.0, abs=1.0)
    assert after[0] == pytest.approx(6.0, abs=1.0)


@pytest.mark.parametrize(
    "links",
    [
        [{"channel": "rayleigh", "doppler_hz": doppler_hz} for doppler_hz in (1.0, 5.0, 20.0)],
        [{"channel": "burst", "burst_slots": slots} for slots in (2.0, 4.0, 16.0)],
    ],
    ids=["fading", "bursts"],
)
def test_where_slots_fade_together_few_frames_carry_less_than_was_counted_on(links):
    layout = layout_for(SMALL_HW := (240, 320))
    symbols = np.ones((layout.num_slots, layout.data_per_slot), np.complex64)
    short, num_frames = 0, 60
    for settings in links:
        link, reporter = Link(ChannelSettings(snr_db=8.0, **settings), 0), LinkReporter("jpeg-amc")
        counted_on_db = None
        for k in range(num_frames):
            equalised = link.receive(EncodedImage(SMALL_HW, symbols, "16qam"), 0.1 * k, k)
            if counted_on_db is not None:
                mode = [mode for mode in ADAPTIVE_MODES if mode.min_snr_db <= counted_on_db][-1]
                carried = SlotSnrs.of(equalised).carried(mode.bits_per_symbol).mean()
                least_db = mode.min_snr_db - MODE_MARGIN_DB
                short += snr_db_that_carries(mode.bits_per_symbol, carried) < least_db
            counted_on_db = reporter.snr_db(equalised)
    assert short < 0.15 * 3 * num_frames  # 0.4 with slots taken to fade independently


def test_slow_fading_is_followed_from_frame_to_frame():
    rising = frames(*[[snr] * 15 for snr in (2.0, 2.4, 2.9, 3.5, 4.2, 5.0, 6.0)])
    assert steady_snr_db(rising, 4) > db(4.2)
    falling = rising[::-1]
    assert steady_snr_db(falling, 4) < db(2.0)


def test_frames_that_differ_by_chance_leave_the_margin_of_their_slots():
    independent = frames(*np.random.default_rng(1).exponential(5.0, (8, 32)))
    together = frames(*[[snr] * 32 for snr in (1, 9, 2, 7, 3, 12, 4, 5)])
    carried = np.array([frame.carried(4) for frame in independent])
    bits = carried.mean() - 1.645 * math.sqrt(9 / 8 * carried.var() / 32)
    expected = snr_db_that_carries(4, bits) + MODE_MARGIN_DB
    assert steady_snr_db(independent, 4) == pytest.approx(expected)
    assert steady_snr_db(together, 4) < db(1.0)


def test_a_link_that_falls_while_it_fades_is_followed_within_two_frames():
    fading = ChannelSettings(channel="rayleigh", snr_db=12.0)
    reporter = LinkReporter("jpeg-amc")
    before = reports(reporter, fading, range(8))
    after = reports(reporter, ChannelSettings(channel="rayleigh", snr_db=3.0), [8, 9])
    alone = reports(LinkReporter("jpeg-amc"), ChannelSettings(channel="rayleigh", snr_db=3.0), [8, 9])
    assert after[1] == pytest.approx(alone[1], abs=1.0)
    assert after[1] < before[-1] - 5.0


def test_frames_of_another_size_begin_anew():
    reporter = LinkReporter("jpeg-amc")
    fading = ChannelSettings(channel="rayleigh", snr_db=10.0)
    reports(reporter, fading, range(5))
    layout = layout_for((64, 64))
    small = EncodedImage((64, 64), np.ones((layout.num_slots, layout.data_per_slot), np.complex64), "16qam")
    equalised = Link(fading, 3).receive(small, 0.0)
    assert reporter.snr_db(equalised) == LinkReporter("jpeg-amc").snr_db(equalised)


def test_learned_codecs_are_told_the_average():
    layout = layout_for(HW)
    symbols = np.ones((layout.num_slots, layout.data_per_slot), np.complex64)
    link = Link(ChannelSettings(channel="erasure", snr_db=9.0), 0)
    equalised = link.receive(EncodedImage(HW, symbols, "16qam"), 0.0)
    assert LinkReporter("3dcsc-lite").snr_db(equalised) == equalised.snr_db
