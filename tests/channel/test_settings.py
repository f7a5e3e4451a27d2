import math
from pathlib import Path

import numpy as np
import pytest

from semcast.channel.registry import MODELS, build_channel
from semcast.channel.settings import ChannelSettings
from semcast.common.config import build_settings, to_toml
from semcast.common.errors import ConfigError


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"snr_db": 42.0}, r"snr_db must be in \[-5, 30\], got 42"),
        ({"snr_db": math.nan}, r"snr_db must be in \[-5, 30\], got nan"),
        ({"slot_loss": 1.0}, r"slot_loss must be in \[0, 0.99\], got 1"),
        ({"frame_loss": -0.1}, r"frame_loss must be in \[0, 1\], got -0.1"),
        ({"jitter_ms": -1.0}, r"jitter_ms must be in \[0, 10000\], got -1"),
        ({"trace_end_db": -6.0}, r"trace_end_db must be in \[-5, 30\], got -6"),
        ({"burst_slots": 0.5}, r"burst_slots must be in \[1, 1000\], got 0.5"),
        ({"burst_noise_db": 61.0}, r"burst_noise_db must be in \[0, 60\], got 61"),
        ({"rician_k_db": 41.0}, r"rician_k_db must be in \[-20, 40\], got 41"),
        ({"doppler_hz": -1.0}, r"doppler_hz must be in \[0, 2000\], got -1"),
        ({"slot_ms": 0.0}, r"slot_ms must be in \[0.001, 1000\], got 0"),
        ({"trace_step_db": 11.0}, r"trace_step_db must be in \[0, 10\], got 11"),
        ({"delay_ms": 20_000.0}, r"delay_ms must be in \[0, 10000\], got 20000"),
        ({"trace_s": 0.0}, r"trace_s must be in \[0.01, 86400\], got 0"),
        ({"channel": "wire"}, "channel must be one of awgn, rayleigh, rician, .* got 'wire'"),
        ({"trace": "hill"}, "trace must be one of constant, ramp, walk, file, got 'hill'"),
        (
            {"channel": "burst", "slot_loss": 0.9, "burst_slots": 2.0},
            "burst_slots must be at least 9 .* got 2",
        ),
        ({"channel": "trace", "trace": "file"}, "trace_file must be given for trace 'file', got None"),
    ],
)
def test_bad_settings_name_field_value_and_range(values, message):
    with pytest.raises(ValueError, match=message):
        ChannelSettings(**values)


def test_bursts_may_be_as_short_as_their_share_allows():
    for share, slots in ((0.8, 4.0), (0.9, 9.0), (0.99, 99.0)):
        assert ChannelSettings(channel="burst", slot_loss=share, burst_slots=slots).burst_slots == slots


def test_settings_are_read_from_toml_values():
    settings = build_settings(ChannelSettings, {"channel": "erasure", "snr_db": 4})
    assert (settings.channel, settings.snr_db, settings.slot_loss) == ("erasure", 4.0, 0.2)
    assert 'channel = "erasure"' in to_toml(settings)
    with pytest.raises(ConfigError, match="did you mean 'snr_db'"):
        build_settings(ChannelSettings, {"snr": 3.0})


def draw_of(num_slots=4000, elapsed_s=0.0, seed=0, **values):
    model = build_channel(ChannelSettings(snr_db=10.0, **values), seed)
    return model.draw(num_slots, elapsed_s, np.random.default_rng(1))


@pytest.mark.parametrize("name", MODELS)
def test_a_channel_has_the_gains_the_noise_and_the_losses_of_its_name(name):
    draw = draw_of(channel=name, slot_loss=0.25, burst_slots=2.0, burst_noise_db=20.0)
    noisy = draw.noise_var > 0.2
    assert draw.snr_db == 10.0
    np.testing.assert_allclose(draw.noise_var[~noisy], 0.1, rtol=1e-6)
    np.testing.assert_allclose(draw.noise_var[noisy], 10.0, rtol=1e-6)
    assert noisy.mean() == pytest.approx(0.25 if name == "burst" else 0.0, abs=0.04)
    assert draw.lost.mean() == pytest.approx(0.25 if name == "erasure" else 0.0, abs=0.03)
    power = np.abs(draw.h) ** 2
    assert power.mean() == pytest.approx(1.0, abs=0.07)
    # Rayleigh's power has a standard deviation of 1; Rice's sqrt(1 + 2 K) / (1 + K), K = 6 dB by default.
    k = 10**0.6
    spread = {"rayleigh": 1.0, "rician": math.sqrt(1 + 2 * k) / (1 + k)}.get(name, 0.0)
    assert power.std() == pytest.approx(spread, abs=0.06)


def test_slots_of_a_fading_link_follow_each_other_in_time():
    # Slot 5 of a frame that began 10 ms later is slot 15 of the first, with slots of 1 ms.
    fading = {"channel": "rayleigh", "doppler_hz": 30.0, "slot_ms": 1.0}
    first, later = draw_of(20, **fading), draw_of(10, elapsed_s=0.01, **fading)
    np.testing.assert_allclose(later.h, first.h[10:], atol=1e-5)
    assert abs(draw_of(20, seed=1, **fading).h[0] - first.h[0]) > 0.01


def test_values_of_other_channels_are_named():
    assert ChannelSettings(slot_loss=0.3, rician_k_db=3.0).without_effect() == ["slot_loss", "rician_k_db"]
    assert ChannelSettings(channel="erasure", slot_loss=0.3, snr_db=4.0, delay_ms=5.0).without_effect() == []
    assert ChannelSettings(channel="rician", doppler_hz=20.0, trace_s=3.0).without_effect() == ["trace_s"]


def test_values_that_were_given_are_named_at_their_default_too():
    assert ChannelSettings().without_effect(["slot_loss", "snr_db", "channel", "delay_ms"]) == ["slot_loss"]
    assert ChannelSettings(channel="erasure").without_effect(["slot_loss", "trace_file"]) == ["trace_file"]
    assert ChannelSettings(slot_loss=0.3).without_effect([]) == []


def test_doppler_and_slots_that_no_constant_gain_stands_for_are_told():
    for doppler_hz, slot_ms, within in ((20.0, 1.0, False), (21.0, 1.0, True), (100.0, 0.2, False)):
        settings = ChannelSettings(channel="rician", doppler_hz=doppler_hz, slot_ms=slot_ms)
        assert settings.fades_within_slots is within
    assert not ChannelSettings(doppler_hz=500.0).fades_within_slots


def test_values_of_other_traces_and_of_motion_are_named():
    assert ChannelSettings(channel="trace", trace="walk", trace_s=3.0).without_effect() == ["trace_s"]
    assert ChannelSettings(channel="trace", trace="ramp", trace_s=3.0).without_effect() == []
    by_file = ChannelSettings(channel="trace", trace="file", trace_file=Path("x.csv"), snr_db=3.0)
    assert by_file.without_effect() == ["snr_db"]
    assert ChannelSettings(channel="rayleigh", slot_ms=2.0).without_effect() == ["slot_ms"]
    assert ChannelSettings(channel="rayleigh", slot_ms=2.0, doppler_hz=9.0).without_effect() == []


def test_the_snr_of_a_link_is_named_as_what_it_is():
    assert ChannelSettings(snr_db=6.5).snr_label == "6.5 dB"
    assert ChannelSettings(channel="trace", snr_db=12.0).snr_label == "ramp from 12 dB"
    by_file = ChannelSettings(channel="trace", trace="file", trace_file=Path("x.csv"))
    assert (by_file.snr_label, by_file.has_own_snr) == ("trace", True)
    assert not ChannelSettings(trace="file", trace_file=Path("x.csv")).has_own_snr, "the channel has no trace"
