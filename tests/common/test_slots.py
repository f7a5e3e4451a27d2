"""The slot grid by hand: 48 channel uses for a block of 16x16 pixels, one of them a pilot."""

import pytest

from semcast.common.phy.slots import BLOCK_VALUES, LATENT_CHANNELS, channel_bandwidth_ratio, layout_for


def test_a_block_has_768_values_and_sends_94_of_its_own():
    assert BLOCK_VALUES == 768
    assert LATENT_CHANNELS == 94


def test_an_image_is_padded_to_whole_blocks():
    layout = layout_for((33, 48))
    assert (layout.num_slots, layout.blocks_per_slot) == (3, 3)
    assert (layout.pilots_per_slot, layout.data_per_slot, layout.uses_per_slot) == (3, 141, 144)
    assert layout.num_uses == 432
    assert layout_for((1, 1)).num_uses == 48


def test_one_channel_use_for_16_source_values_and_more_where_blocks_are_padded():
    assert channel_bandwidth_ratio((32, 48)) == 1 / 16
    assert channel_bandwidth_ratio((16, 8)) == 1 / 8


@pytest.mark.parametrize("shape_hw", [(0, 16), (16, 0), (-16, 16)])
def test_an_image_without_pixels_is_refused(shape_hw):
    with pytest.raises(ValueError, match="shape_hw must be positive"):
        layout_for(shape_hw)
