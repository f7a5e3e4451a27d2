import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from semcast.common.codec import LOST_SLOT_SNR_DB
from semcast.common.nets.rounding import rounded_snr_db
from semcast.training.channel import LinkDraw, LinkDrawSettings, draw_links, through_link


def plain_draw(snr_db, gains):
    gain = torch.tensor(gains).view(1, 1, -1, 1)
    level = torch.full((1,), float(snr_db))
    return LinkDraw(level, level, torch.ones(1), gain, torch.zeros_like(gain))


def vars_of(draw):
    return vars(draw).values()


@pytest.mark.parametrize("gain", [1.0, 0.1])
def test_noise_has_half_its_variance_in_each_real_over_what_the_slot_lets_through(gain):
    generator = torch.Generator().manual_seed(0)
    y = torch.zeros(1, 94, 1, 2000)
    snr_db = 3.0
    y_rx, _ = through_link(y, plain_draw(snr_db, [gain]), torch.randn(y.shape, generator=generator))
    linear = gain * 10 ** (snr_db / 10)
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
    # By what the receiver believes, which is wrong in the second slot.
    mistaken = replace(
        plain_draw(10.0, [1.0, 0.1]), estimate_error_db=torch.tensor([0.0, 3.0]).view(1, 1, 2, 1)
    )
    y_rx, effective_db = through_link(y, mistaken, torch.zeros_like(y))
    torch.testing.assert_close(effective_db[0, 0, :, 0], torch.tensor([10.0, 3.0]))
    torch.testing.assert_close(y_rx[0, 0, 1, 0].item(), 10**0.3 / (1 + 10**0.3))


def test_a_lost_slot_is_zero_at_the_floor():
    y = torch.ones(1, 2, 2, 3)
    y_rx, effective_db = through_link(y, plain_draw(10.0, [0.0, 1.0]), torch.ones_like(y))
    assert (y_rx[:, :, 0] == 0).all()
    assert (effective_db[:, :, 0] == LOST_SLOT_SNR_DB).all()
    assert (y_rx[:, :, 1] > 0).all()


def test_draws_follow_the_settings():
    settings = LinkDrawSettings(
        snr_min_db=2.0, snr_max_db=4.0, share_16qam=1.0, share_faded=1.0, share_lossy=0.0
    )
    draw = draw_links(settings, 2000, 8, torch.Generator().manual_seed(0))
    assert draw.snr_db.min() >= 2.0
    assert draw.snr_db.max() <= 4.0
    assert (draw.is_qam == 1).all()
    assert draw.gain.shape == (2000, 1, 8, 1)
    assert draw.gain.mean().item() == pytest.approx(1.0, abs=0.04)
    # Half of the images fade by Rayleigh, with a variance of 1, half by Rice with a factor K of up to 6:
    # the mean of (1 + 2 K) / (1 + K)^2 is 0.506.
    assert draw.gain.var().item() == pytest.approx(0.753, abs=0.06)
    assert (draw.gain > 0).all()
    assert (draw.expected_snr_db - draw.snr_db).std().item() == pytest.approx(1.0, abs=0.07)
    assert draw.estimate_error_db.std().item() == pytest.approx(0.5, abs=0.02)
    again = draw_links(settings, 2000, 8, torch.Generator().manual_seed(0))
    assert all(torch.equal(one, other) for one, other in zip(*map(vars_of, (draw, again)), strict=True))


def test_without_fading_and_loss_every_slot_has_gain_one():
    settings = LinkDrawSettings(share_faded=0.0, share_lossy=0.0)
    assert (draw_links(settings, 50, 8, torch.Generator().manual_seed(0)).gain == 1).all()


def test_images_lose_up_to_the_largest_share_of_their_slots():
    settings = LinkDrawSettings(share_faded=0.0, share_lossy=0.5, lost_max=0.4)
    lost = draw_links(settings, 2000, 100, torch.Generator().manual_seed(0)).gain == 0.0
    share = lost.float().mean(dim=(1, 2, 3))
    # Half of the images lose none, the others 0 to 40 %, all shares alike.
    assert share.mean().item() == pytest.approx(0.5 * 0.2, abs=0.01)
    assert 0.4 < share.max().item() < 0.55
    assert (share > 0.3).float().mean().item() == pytest.approx(0.5 * 0.25, abs=0.03)


def test_shares_and_ranges_are_checked():
    with pytest.raises(ValueError, match=r"share_lossy must be in \[0, 1\], got 1.5"):
        LinkDrawSettings(share_lossy=1.5)
    with pytest.raises(ValueError, match="snr_min_db must be <="):
        LinkDrawSettings(snr_min_db=20.0)
    for values in ({"snr_min_db": math.nan}, {"snr_min_db": -500.0}, {"feedback_sd_db": -1.0}):
        with pytest.raises(ValueError, match=next(iter(values)) + " must be in"):
            LinkDrawSettings(**values)


def test_links_of_rounded_values_as_links_of_analog_ones():
    draw = LinkDraw(
        snr_db=torch.tensor([10.0, 10.0]),
        expected_snr_db=torch.tensor([9.0, 9.0]),
        is_qam=torch.tensor([1.0, 0.0]),
        gain=torch.tensor([1.0, 0.25, 0.0]).view(1, 1, 3, 1).repeat(2, 1, 1, 1),
        estimate_error_db=torch.full((2, 1, 3, 1), 0.5),
    )
    analog = draw.as_analog()
    assert not analog.is_qam.any()
    assert not analog.snr_db.any()
    slots_db = np.array([10.0, 10.0 + 10.0 * np.log10(0.25)])
    for k, arriving_db in enumerate((rounded_snr_db(slots_db), slots_db)):
        gains_db = 10.0 * torch.log10(analog.gain[k, 0, :2, 0])
        np.testing.assert_allclose(gains_db.numpy(), arriving_db, atol=1e-4)
        assert analog.gain[k, 0, 2, 0] == 0.0
    # What the receiver believes is wrong by as much as it would be behind the rounding.
    believed_db = 10.0 * torch.log10(analog.gain) + analog.estimate_error_db
    np.testing.assert_allclose(believed_db[0, 0, :2, 0], rounded_snr_db(slots_db + 0.5), atol=1e-4)
    np.testing.assert_allclose(believed_db[1, 0, :2, 0], slots_db + 0.5, atol=1e-4)
    assert analog.expected_snr_db[0] == pytest.approx(float(rounded_snr_db(9.0)), abs=1e-4)
    assert analog.expected_snr_db[1] == 9.0


def test_values_in_the_next_slot_fade_as_it_does():
    generator = torch.Generator().manual_seed(0)
    draw = draw_links(LinkDrawSettings(share_faded=1.0, share_lossy=0.0), 2, 3, generator)
    behind = torch.zeros(2, 5, 3, 4, dtype=torch.bool)
    behind[:, 3:, 1] = True
    links = draw.per_value(behind)
    assert links.gain.shape == (2, 5, 3, 4)
    torch.testing.assert_close(links.gain[:, 0, :, 0], draw.gain[:, 0, :, 0])
    torch.testing.assert_close(links.gain[:, 3, 1, 0], draw.gain[:, 0, 2, 0])
    y_rx, snr_db = through_link(torch.ones(2, 5, 3, 4), links, torch.zeros(2, 5, 3, 4))
    assert snr_db.shape == y_rx.shape
    torch.testing.assert_close(y_rx, 10 ** (snr_db / 10) / (1 + 10 ** (snr_db / 10)))
