"""Several bandwidth ratios from one model, by resolution."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.common.codec import DecodedImage, displacement_px
from semcast.common.codecs import load_codec
from semcast.common.errors import ConfigError
from semcast.common.image import psnr_db
from semcast.common.phy.slots import layout_for
from semcast.common.rate import (
    NATIVE_RATE,
    RATES,
    RateControl,
    belongs_to,
    coded_shape,
    from_coded,
    slots_at,
    to_coded,
    uses_per_value,
)

FRAME = next(iter(sorted((Path(__file__).resolve().parents[2] / "deploy/demo/kitti_06").rglob("*.jpg"))))


def test_a_shape_by_hand():
    # sqrt(16/24) of 480 is 391.9: 24 rows of blocks; 640*480*3/24 uses are 800 blocks of 48, 33 in a row.
    assert coded_shape((480, 640), "1/24") == (384, 528)
    assert coded_shape((479, 641), "1/16") == (479, 641)


@pytest.mark.parametrize("shape_hw", [(480, 640), (274, 907), (512, 768), (370, 1226), (90, 120)])
@pytest.mark.parametrize("rate", [rate for rate in RATES if rate != "1/16"])
def test_no_more_uses_than_the_rate_allows_and_hardly_fewer(shape_hw, rate):
    coded = coded_shape(shape_hw, rate)
    share = layout_for(coded).num_uses / (shape_hw[0] * shape_hw[1] * 3) / uses_per_value(rate)
    assert share <= 1.0
    assert share > (0.93 if min(shape_hw) > 200 else 0.6)
    aspect = coded[1] / coded[0] / (shape_hw[1] / shape_hw[0])
    assert 0.65 < aspect < 1.4 if min(shape_hw) < 200 else 0.9 < aspect < 1.1
    assert belongs_to(coded, shape_hw)


@pytest.mark.parametrize("rate", [rate for rate in RATES if rate != "1/16"])
def test_of_small_and_narrow_images_no_rate_is_exceeded_either(rate):
    for short, long in np.random.default_rng(0).integers((16, 16), (64, 700), (300, 2)).tolist():
        for shape_hw in ((short, long), (long, short)):
            allowed = short * long * 3 * uses_per_value(rate)
            assert layout_for(coded_shape(shape_hw, rate)).num_uses <= max(allowed, 4 * 48), shape_hw


def test_an_image_is_made_smaller_by_averaging_and_at_the_native_rate_it_stays():
    noise = np.random.default_rng(0).integers(0, 256, (96, 96, 3)).astype(np.uint8)
    assert to_coded(noise, NATIVE_RATE) is noise
    small = to_coded(noise, "1/48")
    assert small.shape[:2] == coded_shape((96, 96), "1/48")
    # The mean over three pixels has 1 / sqrt(3) of the noise; interpolated pixels keep nearly all of it.
    assert small.std() < 0.65 * noise.std()


def test_only_sizes_of_a_rate_belong_to_a_camera():
    assert belongs_to((480, 640), (480, 640))
    assert not belongs_to((480, 624), (480, 640))
    assert not belongs_to((640, 480), (480, 640))


def test_displacement_grows_with_the_image_and_maps_get_its_size():
    moved_px = np.full((240, 320), 0.5, np.float32)
    small = DecodedImage(
        image=np.full((240, 320, 3), 90, np.uint8),
        confidence=np.full((240, 320), 0.75, np.float32),
        keypoint_confidence=1.0 / (1.0 + moved_px),
    )
    large = from_coded(small, (480, 640))
    assert large.image.shape == (480, 640, 3)
    assert np.all(large.image == 90)
    assert np.all(large.confidence == large.confidence[0, 0])
    assert 0.72 < large.confidence[0, 0] < 0.75, "a plane has no detail to lose"
    np.testing.assert_allclose(displacement_px(large.keypoint_confidence), 1.0, rtol=1e-5)
    assert from_coded(large, (480, 640)) is large


def test_confidence_falls_only_where_the_camera_had_more_pixels():
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    decoded = DecodedImage(image=image, confidence=np.full((240, 320), 0.75, np.float32))
    assert from_coded(decoded, (480, 640)).confidence.max() < 0.6
    np.testing.assert_allclose(from_coded(decoded, (120, 160)).confidence, 0.75, rtol=1e-6)


def test_a_lost_slot_marks_every_band_it_touches():
    coded = np.array([10, 10, -20, 10], np.float32)  # the third quarter of the image
    np.testing.assert_array_equal(slots_at(coded, 64, 96), np.array([10, 10, 10, -20, -20, 10], np.float32))
    np.testing.assert_array_equal(slots_at(coded, 64, 128), np.repeat(coded, 2))
    np.testing.assert_array_equal(slots_at(coded, 64, 32), np.array([10, -20], np.float32))
    assert slots_at(coded, 64, 64) is coded


@pytest.mark.parametrize("height", [90, 274, 370, 480])
@pytest.mark.parametrize("rate", RATES)
def test_no_row_of_a_lost_slot_looks_sound(height, rate):
    coded_height = coded_shape((height, 900), rate)[0]
    num_slots = layout_for((coded_height, 16)).num_slots
    for lost in range(num_slots):
        coded = np.where(np.arange(num_slots) == lost, -20.0, 10.0).astype(np.float32)
        bands = slots_at(coded, coded_height, height)
        assert len(bands) == layout_for((height, 16)).num_slots
        # A row of the camera shows the coded rows it covers.
        top = np.arange(height) * coded_height / height
        bottom = (np.arange(height) + 1) * coded_height / height
        touched = (bottom > 16 * lost + 1e-6) & (top < 16 * (lost + 1) - 1e-6)
        marked = np.repeat(bands, 16)[:height] < 0
        assert marked[touched].all()
        assert marked.sum() <= touched.sum() + 32, "at most the bands at its edges are lost with it"


def test_auto_spends_more_on_a_bad_link_and_does_not_flutter():
    control = RateControl("auto", (480, 640))
    assert control.choose(10.0) == "1/16"
    assert [control.choose(s) for s in (-10.0, 2.0, 30.0)] == ["1/8", "1/8", "1/48"]
    # 6 dB: 2.32 of 3.46 bits, so 1/10.7, between 1/12 and 1/8: either may stand.
    seen = {control.choose(6.0)}
    for noise_db in np.linspace(-0.3, 0.3, 13):
        seen.add(control.choose(6.0 + float(noise_db)))
    assert len(seen) == 1
    assert RateControl("1/24", (480, 640)).choose(-10.0) == "1/24"
    with pytest.raises(ValueError, match="rate must be auto or one of 1/48, .*, got '1/7'"):
        RateControl("1/7", (480, 640))


def test_channel_uses_by_hand():
    assert RateControl("1/16", (480, 640)).num_uses == (30 * 40 * 48,) * 2
    assert RateControl("auto", (480, 640)).num_uses == (17 * 23 * 48, 42 * 57 * 48)


def test_rates_whose_frames_are_too_large_are_not_taken():
    huge = (4000, 6000)
    with pytest.raises(
        ConfigError, match=r"rate must be one of 1/48, .* for frames of 6000x4000, got '1/8'; resize"
    ):
        RateControl("1/8", huge)
    # Of the second each rate has few enough samples, and some have sides that are short enough.
    for too_large in ((12000, 12000), (1008, 9008)):
        with pytest.raises(ConfigError, match="resize must make frames smaller: those of"):
            RateControl("auto", too_large)
    control = RateControl("auto", huge)
    assert uses_per_value(control.choose(-10.0)) < uses_per_value("1/8")


def test_quality_rises_with_the_rate_under_one_set_of_weights():
    photo = cv2.cvtColor(cv2.imread(str(FRAME)), cv2.COLOR_BGR2RGB)
    from semcast.channel.link import Link
    from semcast.channel.settings import ChannelSettings

    codec = load_codec("3dcsc-lite")
    found = {}
    for rate in ("1/48", "1/16", "1/8"):
        link = Link(ChannelSettings(snr_db=8.0), 0)
        received = link.carry(codec.encode(to_coded(photo, rate), 8.0), 0.0)
        decoded = from_coded(codec.decode(received), photo.shape[:2])
        assert decoded.image.shape == photo.shape
        found[rate] = psnr_db(photo, decoded.image)
    assert found["1/48"] + 0.5 < found["1/16"] < found["1/8"] - 0.5
