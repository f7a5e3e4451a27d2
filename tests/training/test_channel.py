import math

import pytest
import torch

from semcast.common.codec import LOST_SLOT_SNR_DB
from semcast.training.channel import ChannelSettings, LinkDraw, draw_links, through_link


def plain_draw(snr_db, gains):
    gain = torch.tensor(gains).view(1, 1, -1, 1)
    level = torch.full((1,), float(snr_db))
    return LinkDraw(level, level, torch.ones(1), gain, torch.zeros_like(gain))


def test_noise_has_half_its_variance_in_each_real():
    generator = torch.Generator().manual_seed(0)
    y = torch.zeros(1, 94, 1, 2000)
    snr_db = 3.0
    y_rx, _ = through_link(y, plain_draw(snr_db, [1.0]), torch.randn(y.shape, generator=generator))
    linear = 10 ** (snr_db / 10)
    unshrunk = y_rx * (1 + linear) / linear
    expected = 0.5 / linear
    sigma = expected * (2 / y.numel()) ** 0.5
    assert abs(unshrunk.square().mean().item() - expected) < 4 * sigma


def test_the_equaliser_shrinks_by_snr_over_one_plus_snr():
    y = torch.ones(1, 2, 2, 3)
    y_rx, effective_db = through_link(y, plain_draw(10.0, [1.0, 0.1]), torch.zeros_like(y))
    torch.testing.assert_close(y_rx[0, 0, 0], torch.full((3,), 10 / 11))
    torch.testing.assert_close(y_rx[0, 0, 1], torch.full((3,), 0.5))
    torch.testing.assert_close(effective_db[0, 0, :, 0], torch.tensor([10.0, 0.0]))


def test_a_lost_slot_is_zero_at_the_floor():
    y = torch.ones(1, 2, 2, 3)
    y_rx, effective_db = through_link(y, plain_draw(10.0, [0.0, 1.0]), torch.ones_like(y))
    assert (y_rx[:, :, 0] == 0).all()
    assert (effective_db[:, :, 0] == LOST_SLOT_SNR_DB).all()
    assert (y_rx[:, :, 1] > 0).all()


def test_draws_follow_the_settings():
    settings = ChannelSettings(
        snr_min_db=2.0, snr_max_db=4.0, share_16qam=1.0, share_faded=1.0, share_lossy=0.0
    )
    draw = draw_links(settings, 2000, 8, torch.Generator().manual_seed(0))
    assert draw.snr_db.min() >= 2.0
    assert draw.snr_db.max() <= 4.0
    assert (draw.is_qam == 1).all()
    assert draw.gain.shape == (2000, 1, 8, 1)
    assert draw.gain.mean().item() == pytest.approx(1.0, abs=0.04)
    assert (draw.gain > 0).all()


def test_without_fading_and_loss_every_slot_has_gain_one():
    settings = ChannelSettings(share_faded=0.0, share_lossy=0.0)
    assert (draw_links(settings, 50, 8, torch.Generator().manual_seed(0)).gain == 1).all()


def test_shares_and_ranges_are_checked():
    with pytest.raises(ValueError, match=r"share_lossy must be in \[0, 1\], got 1.5"):
        ChannelSettings(share_lossy=1.5)
    with pytest.raises(ValueError, match="snr_min_db must be <="):
        ChannelSettings(snr_min_db=20.0)
    for values in ({"snr_min_db": math.nan}, {"snr_min_db": -500.0}, {"feedback_sd_db": -1.0}):
        with pytest.raises(ValueError, match=next(iter(values)) + " must be in"):
            ChannelSettings(**values)
