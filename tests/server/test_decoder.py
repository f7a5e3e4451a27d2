"""Codecs of a stream are made ready at a bounded cost."""

import numpy as np
import pytest

from semcast.common.codec import DecodedImage
from semcast.server.decoder import MAX_WARM_UP_PX, FrameDecoder


class NotingCodec:
    """Decodes grey, and notes what shapes it was asked for."""

    name, digest, modulation = "noting", "", "16qam"

    def __init__(self):
        self.shapes = []

    def decode(self, received):
        self.shapes.append(received.shape_hw)
        return DecodedImage(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))


@pytest.mark.parametrize("shape_hw", [(480, 641), (1080, 1920), (1, 4)])
def test_a_codec_is_warmed_up_with_images_of_the_camera_s_size(shape_hw):
    codec = NotingCodec()
    FrameDecoder(lambda name, modulation: codec).warm_up("noting", "16qam", "", shape_hw)
    assert codec.shapes == [shape_hw]


def test_a_camera_that_says_it_is_huge_costs_no_more_than_a_large_one():
    codec = NotingCodec()
    FrameDecoder(lambda name, modulation: codec).warm_up("noting", "16qam", "", (8192, 8192))
    ((height, width),) = codec.shapes
    assert height == width
    assert 0.99 * MAX_WARM_UP_PX < height * width <= MAX_WARM_UP_PX
