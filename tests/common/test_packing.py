"""Values of blocks fill the slots one after another, and come back."""

import numpy as np
import pytest
import torch

from semcast.common.nets import modulation_numpy
from semcast.common.nets.modulation import (
    analog_symbols,
    carrier_pattern,
    rounded_symbols,
    undo_analog,
)
from semcast.common.nets.modulation_numpy import CARRIER_AMPLITUDE
from semcast.common.nets.packing import blocks_arrived, pack, sent_mask, share_plane, unpack
from semcast.common.phy.allocation import MAX_VALUES

VALUES = torch.tensor([[[[12, 188, 94], [24, 48, 94]]]])


def blocks(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(1, MAX_VALUES, 2, 3, generator=generator)


def test_the_first_values_of_a_block_are_sent():
    sent = sent_mask(VALUES, MAX_VALUES)
    assert sent.sum(dim=1).long().tolist() == VALUES[:, 0].tolist()
    assert sent[0, :12, 0, 0].all()
    assert not sent[0, 12:, 0, 0].any()


def test_the_usual_share_is_zero_and_doubling_it_adds_one_half():
    plane = share_plane(torch.tensor([[[[94, 188]]]]))
    assert plane.flatten().tolist() == [0.0, 0.5]


def test_values_follow_each_other_block_by_block():
    symbols, sent = blocks(), sent_mask(VALUES, MAX_VALUES)
    packed = pack(symbols, sent)
    assert packed.shape == (1, 94, 2, 3)
    stream = packed[0].permute(1, 2, 0).reshape(-1)
    torch.testing.assert_close(stream[:12], symbols[0, :12, 0, 0])
    torch.testing.assert_close(stream[12:200], symbols[0, :188, 0, 1])
    rest = stream[int(VALUES.sum()) :]
    torch.testing.assert_close(rest.square(), torch.full_like(rest, 0.5))


def test_unpacking_inverts_packing():
    symbols, sent = blocks(), sent_mask(VALUES, MAX_VALUES)
    torch.testing.assert_close(unpack(pack(symbols, sent), sent), symbols * sent)


def test_only_what_is_sent_counts_for_power_and_carrier():
    latent, sent = 3.0 * blocks() + 1.0, sent_mask(VALUES, MAX_VALUES)
    symbols = analog_symbols(latent, sent)
    assert float(2 * symbols.square().sum() / sent.sum()) == pytest.approx(1.0, abs=1e-4)
    assert not symbols[sent == 0].any()
    louder = latent + 100.0 * (1.0 - sent)
    torch.testing.assert_close(analog_symbols(louder, sent), symbols)
    back, scale = undo_analog(symbols, torch.ones(1, 1, 2, 3), sent)
    assert float(scale) == pytest.approx((2 * (3.0**2 + 1.0**2)) ** 0.5, rel=0.08)
    # What lay along the carrier is lost, a few hundredths of the latent.
    assert float((back - latent * sent).square().sum() / (latent * sent).square().sum()) < 0.03


@pytest.mark.parametrize("way", ["16qam", "analog"])
def test_packing_without_torch_is_the_same(way):
    latent, sent = blocks(), sent_mask(VALUES, MAX_VALUES)
    is_qam = torch.tensor([float(way == "16qam")])
    expected = rounded_symbols(pack(analog_symbols(latent, sent), sent), is_qam)[0].numpy()
    ours = modulation_numpy.transmit(latent[0].numpy(), way, VALUES[0, 0].numpy())
    assert (np.abs(ours - expected) > 2e-6).mean() < 0.001


def test_blocks_in_two_slots_are_brought_to_one_factor():
    """A link without noise, whose slots are shrunk differently: every value comes back as large as it was."""
    latent, sent = blocks(), sent_mask(VALUES, MAX_VALUES)
    slots = torch.tensor([0.9, 0.5]).view(1, 1, 2, 1).expand(1, 94, 2, 3)
    symbols = analog_symbols(latent, sent)
    shrink = unpack(slots, sent)
    y, snr_db, of_block, scale = blocks_arrived(unpack(pack(symbols, sent) * slots, sent), shrink, sent)
    # The second block holds values 13 to 200 of the frame, a slot 282.
    assert float(of_block[0, 0, 0, 0]) == pytest.approx(0.9)
    assert float(of_block[0, 0, 1, 2]) == pytest.approx(0.5)
    third = (82 * 0.9 + 12 * 0.5) / 94  # values 201 to 294
    assert float(of_block[0, 0, 0, 2]) == pytest.approx(third)
    assert float(snr_db[0, 0, 1, 2]) == pytest.approx(0.0, abs=1e-4)
    assert float(snr_db[0, 0, 0, 2]) == pytest.approx(10.0 * np.log10(third / (1.0 - third)), abs=1e-4)
    carrier = CARRIER_AMPLITUDE * carrier_pattern(symbols) * sent
    torch.testing.assert_close((y / of_block + carrier) / scale, symbols, rtol=1e-3, atol=1e-3)
