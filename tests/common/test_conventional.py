import re

import cv2
import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import ReceivedImage
from semcast.common.codecs import available_codecs, load_codec
from semcast.common.conventional import ADAPTIVE_MODES, ConventionalCodec
from semcast.common.conventional_source import compress, compress_to_fit, decompress, supported
from semcast.common.conventional_transport import Transport
from semcast.common.errors import ConfigError
from semcast.common.image import psnr_db
from semcast.common.link_report import LinkReporter
from semcast.common.phy.qam import indices_to_symbols, symbols_to_indices
from semcast.common.phy.slots import layout_for


@pytest.fixture(scope="module")
def picture():
    """Smooth shapes with some texture, 160x240."""
    rng = np.random.default_rng(4)
    image = np.full((160, 240, 3), 90, np.uint8)
    for _ in range(25):
        centre = tuple(int(v) for v in rng.integers(0, 240, 2))
        colour = tuple(int(v) for v in rng.integers(0, 256, 3))
        cv2.circle(image, centre, int(rng.integers(5, 40)), colour, -1, cv2.LINE_AA)
    texture = cv2.GaussianBlur(rng.normal(0, 25, (160, 120, 3)), (0, 0), 1.0)
    image[:, :120] = np.clip(image[:, :120] + texture, 0, 255)
    return image


def through(codec, image, snr_db, seed=0, **settings):
    link = Link(ChannelSettings(snr_db=snr_db, **settings), seed)
    return codec.decode(link.carry(codec.encode(image, snr_db), 0.0))


def test_symbols_fill_exactly_the_data_uses_with_16qam_points(picture):
    encoded = load_codec("jpeg-ldpc").encode(picture, 10.0)
    layout = layout_for((160, 240))
    assert encoded.symbols.shape == (layout.num_slots, layout.data_per_slot)
    assert encoded.symbols.dtype == np.complex64
    on_grid = indices_to_symbols(symbols_to_indices(encoded.symbols))
    np.testing.assert_allclose(encoded.symbols, on_grid, atol=1e-6)
    assert np.mean(np.abs(encoded.symbols) ** 2) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("name", ["jpeg-ldpc", "webp-ldpc", "avif-ldpc", "jpeg-amc", "avif-slow-amc"])
def test_a_good_link_delivers_the_compressed_image_unharmed(name, picture):
    if name not in available_codecs():
        pytest.skip(f"this OpenCV has no {name.split('-')[0]}")
    decoded = through(load_codec(name), picture, 10.0)
    assert not decoded.outage
    assert decoded.image.shape == picture.shape
    assert psnr_db(decoded.image, picture) > 22.0
    np.testing.assert_array_equal(decoded.image, through(load_codec(name), picture, 10.0, seed=9).image)


def test_a_slow_avif_is_better_over_the_same_channel_uses_and_read_by_the_same_receiver(picture):
    if "avif-amc" not in available_codecs():
        pytest.skip("this OpenCV has no avif")
    quick, slow = load_codec("avif-amc"), load_codec("avif-slow-amc")
    assert (quick.name, slow.name, slow.digest) == ("avif-amc", "avif-slow-amc", quick.digest)
    link = Link(ChannelSettings(snr_db=10.0), 0)
    of_quick, of_slow = (quick.decode(link.carry(c.encode(picture, 10.0), 0.0, 0)) for c in (quick, slow))
    assert psnr_db(of_slow.image, picture) > psnr_db(of_quick.image, picture) + 0.1


def test_below_the_waterfall_the_frame_is_an_outage(picture):
    decoded = through(load_codec("jpeg-ldpc"), picture, 3.0)
    assert decoded.outage
    assert (decoded.image == 128).all()
    assert not decoded.confidence.any()


def test_a_fifth_of_the_slots_lost_is_repaired_by_the_interleaved_code(picture):
    decoded = through(load_codec("jpeg-ldpc"), picture, 13.0, channel="erasure")
    assert not decoded.outage


def test_the_adaptive_codec_works_where_the_fixed_one_fails_and_is_better_above(picture):
    adaptive, fixed = load_codec("jpeg-amc"), load_codec("jpeg-ldpc")
    assert not through(adaptive, picture, 2.5).outage
    better = psnr_db(through(adaptive, picture, 13.0).image, picture)
    assert better > psnr_db(through(fixed, picture, 13.0).image, picture) + 0.5


@pytest.mark.parametrize("snr_db", [pytest.param(10.0, marks=pytest.mark.slow), 20.0])
def test_lost_slots_leave_the_adaptive_codec_few_outages(snr_db, picture):
    """What a strong link has in excess in some slots can't make up for those that are lost."""
    codec, image = load_codec("jpeg-amc"), np.vstack([picture] * 3)
    link = Link(ChannelSettings(channel="erasure", slot_loss=0.2, snr_db=snr_db), 4)
    reporter, reported_db, outages = LinkReporter(codec.name), snr_db, 0
    for k in range(30):
        equalised = link.receive(codec.encode(image, reported_db), 0.1 * k)
        outages += codec.decode(equalised.received).outage
        reported_db = reporter.snr_db(equalised)
    assert outages <= 4


@pytest.mark.parametrize("mode", ADAPTIVE_MODES)
def test_every_adaptive_mode_is_recognised_by_the_receiver(mode, picture):
    codec = load_codec("jpeg-amc")
    # A quarter of a bit a use must hold the tables of a JPEG file first.
    large = np.tile(picture, (2, 2, 1)) if mode in ADAPTIVE_MODES[:5] else picture
    expected_db = max(mode.min_snr_db, -5.0) + 0.05
    # Half a dB above the switching point, for the short blocks of a small image.
    link = Link(ChannelSettings(snr_db=max(expected_db, 0.0) + 0.5), 1)
    assert not codec.decode(link.carry(codec.encode(large, expected_db), 0.0)).outage


def test_confidence_is_the_mean_label_of_the_pixels_it_marks(picture):
    decoded = through(load_codec("jpeg-ldpc"), picture, 12.0)
    error = np.abs(decoded.image.astype(float) - picture).mean(axis=2) / 255
    label = 1 - np.tanh(30 * error)
    assert decoded.confidence.shape == (160, 240)
    assert decoded.confidence.mean() == pytest.approx(label.mean(), abs=0.005)
    # Flat parts are better coded than texture, and the map says so.
    assert np.unique(decoded.confidence).size > 3
    assert np.corrcoef(decoded.confidence.ravel(), label.ravel())[0, 1] > 0.4


@pytest.mark.parametrize("shape_hw", [(16, 16), (17, 33), (48, 16), (9, 200)])
@pytest.mark.parametrize("name", ["jpeg-ldpc", "jpeg-amc"])
def test_odd_and_tiny_images_never_raise(name, shape_hw, rng):
    image = rng.integers(0, 256, (*shape_hw, 3)).astype(np.uint8)
    codec = load_codec(name)
    decoded = through(codec, image, 9.0)
    assert decoded.image.shape == image.shape


@pytest.mark.parametrize("shape_hw", [(113, 161), (65, 401), (247, 99)])
@pytest.mark.parametrize("name", ["jpeg-ldpc", "jpeg-amc"])
def test_odd_images_that_fit_get_through(name, shape_hw):
    rows, columns = np.indices(shape_hw)
    image = np.stack([100 + rows, 80 + columns / 2, 90 + 0 * rows], axis=-1).astype(np.uint8)
    decoded = through(load_codec(name), image, 15.0)
    assert not decoded.outage
    assert psnr_db(decoded.image, image) > 24.0


def test_garbage_is_an_outage_and_nothing_worse(rng):
    codec = load_codec("jpeg-ldpc")
    layout = layout_for((64, 64))
    for scale, snr_db in ((1.0, 5.0), (0.0, -20.0), (50.0, 40.0)):
        noise = rng.standard_normal((layout.num_slots, layout.data_per_slot, 2)) @ np.array([1, 1j])
        received = ReceivedImage(
            shape_hw=(64, 64),
            symbols=(scale * noise).astype(np.complex64),
            effective_snr_db=np.full(layout.num_slots, snr_db, np.float32),
            modulation="16qam",
        )
        assert codec.decode(received).outage


@pytest.mark.parametrize("name", ["jpeg-ldpc", "jpeg-amc"])
@pytest.mark.parametrize("snr_db", [np.nan, np.inf, -np.inf, 1e6])
def test_values_that_are_no_numbers_count_as_lost(name, snr_db, picture):
    codec = load_codec(name)
    encoded = codec.encode(picture, 10.0)
    slots = np.full(len(encoded.symbols), 20.0, np.float32)
    damaged, slots[1] = encoded.symbols.copy(), snr_db
    damaged[0, 3] = np.nan
    decoded = codec.decode(ReceivedImage(encoded.shape_hw, damaged, slots, encoded.modulation))
    assert not decoded.outage, "the code repairs two lost slots"
    nothing = np.full_like(encoded.symbols, np.nan)
    slots = np.full(len(nothing), snr_db, np.float32)
    assert codec.decode(ReceivedImage(encoded.shape_hw, nothing, slots, encoded.modulation)).outage


def test_sizes_that_contradict_each_other_are_named(picture):
    codec = load_codec("jpeg-ldpc")
    encoded = codec.encode(picture, 10.0)
    slots = np.full(len(encoded.symbols), 20.0, np.float32)
    with pytest.raises(ValueError, match="symbols must have shape"):
        codec.decode(ReceivedImage((16, 16), encoded.symbols, slots, "16qam"))
    with pytest.raises(ValueError, match="effective_snr_db must have shape"):
        codec.decode(ReceivedImage(encoded.shape_hw, encoded.symbols, slots[1:], "16qam"))


def test_one_instance_serves_changing_image_sizes(picture):
    codec = load_codec("jpeg-ldpc")
    for image in (picture, picture[:96], picture):
        assert not through(codec, np.ascontiguousarray(image), 10.0).outage


def test_the_highest_quality_that_fits_is_found_from_any_start(picture):
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    budget = len(compress(bgr, "jpeg", 40)) + 1
    found = {compress_to_fit(picture, "jpeg", budget, hint) for hint in (1, 20, 40, 60, 100)}
    assert len(found) == 1
    quality, data = found.pop()
    assert len(data) <= budget < len(compress(bgr, "jpeg", quality + 1))
    assert compress_to_fit(picture, "jpeg", 10) is None


def test_under_a_tight_budget_a_smaller_image_is_sent(picture):
    quality, data = compress_to_fit(picture, "jpeg", 1400)
    small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert small.shape[0] < 160
    assert quality >= 1
    assert decompress(data, (160, 240)).shape == picture.shape
    assert decompress(b"no image", (160, 240)) is None
    assert decompress(b"", (160, 240)) is None


def test_a_smaller_image_is_sent_where_it_comes_closer_to_the_original(picture):
    blurred = cv2.GaussianBlur(picture, (0, 0), 3)
    bgr = cv2.cvtColor(blurred, cv2.COLOR_RGB2BGR)
    whole = compress(bgr, "jpeg", 25)
    _, data = compress_to_fit(blurred, "jpeg", len(whole))
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape[0] < 160
    gain_db = psnr_db(decompress(data, (160, 240)), blurred) - psnr_db(decompress(whole, (160, 240)), blurred)
    assert gain_db > 0.1


def test_jpeg_is_always_there():
    assert supported("jpeg")


def test_a_damaged_block_fails_its_crc(rng):
    transport = Transport(3000, 4, 0.5)
    payload = rng.bytes(transport.capacity_bytes)
    symbols = transport.encode(payload)
    clean = np.full(3000, 0.01, np.float32)
    none = np.zeros(3000, bool)
    assert transport.decode(symbols, clean, none) == payload
    assert transport.decode(-symbols, clean, none) is None
    assert transport.decode(symbols, clean, np.ones(3000, bool)) is None
    assert transport.decode(transport.encode(b""), clean, none) == b""
    with pytest.raises(ValueError, match="payload must have at most 742 bytes, got 743"):
        transport.encode(bytes(743))


def test_only_codecs_that_can_be_used_are_listed(tmp_path, monkeypatch):
    (tmp_path / "vit.safetensors").touch()
    (tmp_path / "3dcsc-lite.safetensors").touch()
    (tmp_path / "3dcsc-lite.json").touch()
    monkeypatch.setattr("semcast.common.codecs.resources.files", lambda package: tmp_path)
    assert available_codecs()[:3] == ["3dcsc-lite", "vit", "jpeg-ldpc"]


def test_codecs_are_found_by_name():
    codec = load_codec("jpeg-ldpc")
    assert codec.name == "jpeg-ldpc"
    assert len(codec.digest) == 16
    assert codec.digest != load_codec("jpeg-amc").digest
    with pytest.raises(
        ConfigError, match=r"codec must be one of .*, got 'jpg-ldpc', did you mean 'jpeg-ldpc'\?"
    ):
        load_codec("jpg-ldpc")
    with pytest.raises(ConfigError, match="modulation must be one of 16qam, analog, got '16-qam'"):
        load_codec("jpeg-ldpc", modulation="16-qam")
    with pytest.raises(ConfigError, match="codec 'jpeg-ldpc' has no weights"):
        load_codec("jpeg-ldpc", weights="x")


def test_bad_images_are_named():
    codec = ConventionalCodec("jpeg")
    with pytest.raises(ValueError, match=r"image must have shape \(H W 3\), got \(4, 4\)"):
        codec.encode(np.zeros((4, 4), np.uint8), 10.0)
    with pytest.raises(ValueError, match="image must be uint8, got float64"):
        codec.encode(np.zeros((16, 16, 3)), 10.0)


def told_by_codec(caplog):
    return [record for record in caplog.records if record.name.endswith("conventional")]


@pytest.mark.parametrize(
    ("name", "shape_hw", "capacity"),
    [("jpeg-ldpc", (48, 160), "[1-9][0-9]*"), ("jpeg-amc", (10, 32), "0")],
)
def test_images_for_which_no_file_is_small_enough_are_said_to_be_sent_empty_once(
    name, shape_hw, capacity, caplog
):
    codec = load_codec(name)
    image = np.random.default_rng(0).integers(0, 256, (*shape_hw, 3), dtype=np.uint8)
    assert through(codec, image, 0.0).outage
    assert through(codec, image, 0.0).outage
    height, width = shape_hw
    (record,) = told_by_codec(caplog)
    message = rf"{name}: a frame of {width}x{height} pixels carries {capacity} bytes, too few for any file"
    assert re.match(message, record.getMessage())


def test_images_that_fit_are_warned_of_nothing(picture, caplog):
    through(load_codec("jpeg-ldpc"), picture, 30.0)
    assert not told_by_codec(caplog)
