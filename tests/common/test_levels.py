"""Dark and hazy images are stretched before they are encoded and put back behind the decoder."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codecs import load_codec
from semcast.common.image import psnr_db
from semcast.common.levels import ALL_LEVELS, Levels, levels_of
from semcast.common.nets import codec as nets_codec

PHOTO = Path(__file__).resolve().parents[2] / "deploy/demo/kitti_06/images/000000.jpg"


def uniform(low, high, shape=(64, 96, 3)):
    return np.random.default_rng(0).integers(low, high + 1, size=shape, dtype=np.uint8)


def test_images_that_use_half_of_the_levels_stay_as_they_are():
    image = uniform(40, 180)
    assert levels_of(image) == ALL_LEVELS
    assert ALL_LEVELS.stretch(image) is image
    assert ALL_LEVELS.unstretch(image) is image


@pytest.mark.parametrize(("low", "high"), [(0, 40), (100, 160), (200, 255)])
def test_a_narrow_range_becomes_the_whole_one(low, high):
    image = uniform(low, high)
    levels = levels_of(image)
    # Of 40 or more even levels, clipping one at either end costs less than a quarter.
    assert low <= levels.low <= low + 3
    assert high - 3 <= levels.high <= high
    stretched = levels.stretch(image)
    assert stretched.min() == 0
    assert stretched.max() == 255
    clipped = np.clip(image, levels.low, levels.high)
    np.testing.assert_array_equal(levels.unstretch(stretched), clipped)
    assert np.square(clipped.astype(float) - image).mean() <= 0.5


def test_the_ends_are_the_last_ones_that_cost_a_quarter_of_a_squared_level():
    image = uniform(0, 60, (50, 40, 3))
    levels = levels_of(image)
    seen = image[::2, ::2].astype(float)

    def cost(end):
        return np.square(np.maximum(seen - end, 0.0)).mean()

    assert cost(levels.high) <= 0.25 < cost(levels.high - 1)


def test_lamps_in_the_night_are_kept():
    image = uniform(0, 40, (100, 100, 3))
    image[40:44, 40:44] = 255
    assert levels_of(image) == ALL_LEVELS


@pytest.mark.parametrize("level", [0, 7, 128, 255])
def test_an_even_image_is_not_stretched_beyond_what_noise_fills(level):
    levels = levels_of(np.full((32, 32, 3), level, np.uint8))
    assert levels.high - levels.low == 24
    assert levels.low <= level <= levels.high


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5, 1), (4, 5)])
def test_the_shape_stays(shape):
    image = np.full(shape, 50, np.uint8)
    for found, level in ((Levels(0, 100).stretch(image), 128), (Levels(0, 51).unstretch(image), 10)):
        np.testing.assert_array_equal(found, np.full(shape, level))


@pytest.mark.parametrize(("low", "high"), [(-1, 10), (10, 10), (20, 10), (0, 256)])
def test_levels_out_of_order_are_refused(low, high):
    with pytest.raises(ValueError, match="levels must be 0 <= low < high <= 255, got"):
        Levels(low, high)


@pytest.mark.parametrize(("contrast", "black"), [(0.15, 0), (0.25, 120)])
def test_dark_and_hazy_images_arrive_better(monkeypatch, contrast, black):
    photo = cv2.imread(str(PHOTO))[:256, :512, ::-1]
    image = np.rint(black + contrast * photo).astype(np.uint8)
    codec = load_codec("3dcsc-lite")

    def arriving():
        encoded = codec.encode(image, 6.0)
        link = Link(ChannelSettings(channel="awgn", snr_db=6.0), seed=0)
        received = link.carry(encoded, 0.0)
        return encoded.levels, psnr_db(codec.decode(received).image, image)

    levels, stretched_db = arriving()
    assert levels.low >= black // 2
    assert levels.high < black + 60
    monkeypatch.setattr(nets_codec, "levels_of", lambda _: ALL_LEVELS)
    levels, plain_db = arriving()
    assert levels == ALL_LEVELS
    assert stretched_db > plain_db + 1.0
