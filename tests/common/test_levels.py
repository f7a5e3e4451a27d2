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
from semcast.common.nets import coder_input

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


@pytest.fixture
def night():
    """A dark picture with a lamp."""
    image = uniform(3, 43, (100, 100, 3))
    image[40:44, 40:44] = 255
    image[50, 50:60] = 150
    return image


def test_a_dark_picture_with_lamps_has_a_knee(night):
    levels = levels_of(night)
    assert 3 <= levels.low <= 6
    assert levels.high >= 240
    assert 40 <= levels.knee <= 46
    assert 128 <= levels.knee_at <= 220, "most of the levels are for the dark part"
    assert Levels(*levels.numbers) == levels
    stretched = levels.stretch(night)
    dark = night <= levels.knee
    assert stretched[dark].max() - stretched[dark].min() > 2.5 * 40
    clipped = np.clip(night, levels.low, levels.high)
    np.testing.assert_array_equal(levels.unstretch(stretched)[dark], clipped[dark])
    assert np.abs(levels.unstretch(stretched).astype(int) - clipped).max() <= 1, "lamps are put back as well"
    assert stretched[night == 150].max() < stretched[night == 255].min()


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_picture_that_is_not_dark_or_that_has_much_light_stays_as_it_is(night, share):
    assert levels_of(uniform(0, 150)) == ALL_LEVELS
    num_rows = round(share * 100)
    night[:num_rows] = uniform(100, 255, (num_rows, 100, 3))
    assert levels_of(night) == ALL_LEVELS


def test_a_knee_is_where_noise_costs_least(night):
    levels = levels_of(night)
    values = night[::2, ::2].astype(float)

    def cost(knee, knee_at):
        dark = (values <= knee).sum() * ((knee - levels.low) / knee_at) ** 2
        return dark + 8.0 * (values > knee).sum() * ((levels.high - knee) / (255 - knee_at)) ** 2

    others = [(levels.knee + k, levels.knee_at + at) for k in (-2, 0, 2) for at in (-4, 0, 4)]
    assert cost(levels.knee, levels.knee_at) == min(cost(*other) for other in others)
    assert cost(levels.knee, levels.knee_at) < 0.5 * values.size


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


@pytest.mark.parametrize(
    ("low", "high", "knee", "knee_at"),
    [
        (0, 255, 50, None),
        (0, 255, None, 50),
        (10, 255, 10, 99),
        (0, 90, 90, 99),
        (0, 255, 50, 0),
        (0, 255, 50, 255),
    ],
)
def test_a_knee_outside_the_range_is_refused(low, high, knee, knee_at):
    with pytest.raises(ValueError, match="knee"):
        Levels(low, high, knee, knee_at)


def test_a_night_with_lamps_arrives_better(monkeypatch):
    image = np.rint(0.2 * cv2.imread(str(PHOTO))[:256, :512, ::-1]).astype(np.uint8)
    for x, y in ((60, 40), (200, 90), (380, 60)):
        cv2.circle(image, (x, y), 4, (255, 240, 200), -1, cv2.LINE_AA)
    codec = load_codec("3dcsc-lite")
    dark = image.max(axis=2) < 64

    def arriving_db():
        received = Link(ChannelSettings(channel="awgn", snr_db=6.0), seed=0).carry(
            codec.encode(image, 6.0), 0.0
        )
        decoded = codec.decode(received).image
        return psnr_db(decoded, image), psnr_db(decoded[dark][None], image[dark][None])

    with_knee = arriving_db()
    monkeypatch.setattr(coder_input, "levels_of", lambda _: ALL_LEVELS)
    without = arriving_db()
    assert with_knee[0] > without[0] + 0.5
    assert with_knee[1] > without[1] + 1.0


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
    monkeypatch.setattr(coder_input, "levels_of", lambda _: ALL_LEVELS)
    levels, plain_db = arriving()
    assert levels == ALL_LEVELS
    assert stretched_db > plain_db + 1.0
