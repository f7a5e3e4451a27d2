import json
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from semcast.common.codec import LOST_SLOT_SNR_DB, ReceivedImage
from semcast.common.errors import CheckpointError, ConfigError
from semcast.common.nets.checkpoint import load_transceiver, save_transceiver
from semcast.common.nets.codec import NeuralCodec
from semcast.common.nets.manifest import manifest_path, read_manifest, weights_path
from semcast.common.nets.registry import architecture, architectures, build
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.common.phy.qam import SHAPED_SPACING, pam_levels

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)


@pytest.fixture
def weights(tmp_path):
    torch.manual_seed(0)
    path = tmp_path / "tiny.safetensors"
    model = build_3dcsc(TINY)
    with torch.no_grad():
        model.encoder.linear.transform.weight.mul_(20.0)
    save_transceiver(
        model,
        path,
        architecture="3dcsc",
        sizes=TINY,
        cbr=1 / 16,
        snr_range_db=(0.0, 14.0),
        made_by={"steps": 0},
    )
    return path


def some_image(shape_hw):
    return np.random.default_rng(0).integers(0, 256, size=(*shape_hw, 3), dtype=np.uint8)


def received(encoded, snr_db):
    shrink = 10 ** (snr_db / 10) / (1 + 10 ** (snr_db / 10))
    slots = np.full(encoded.symbols.shape[0], snr_db, np.float32)
    return ReceivedImage(
        encoded.shape_hw, (encoded.symbols * shrink).astype(np.complex64), slots, encoded.modulation
    )


def test_weights_are_readable_like_their_manifest(weights):
    assert weights.stat().st_mode == weights.with_suffix(".json").stat().st_mode


@pytest.mark.parametrize("shape_hw", [(32, 48), (33, 47), (5, 7)])
@pytest.mark.parametrize("modulation", ["16qam", "analog"])
def test_any_image_size_comes_back_at_that_size(weights, shape_hw, modulation):
    codec = NeuralCodec.load(weights, modulation=modulation)
    encoded = codec.encode(some_image(shape_hw), 10.0)
    rows, columns = -(-shape_hw[0] // 16), -(-shape_hw[1] // 16)
    assert encoded.symbols.shape == (rows, 47 * columns)
    decoded = codec.decode(received(encoded, 10.0))
    assert decoded.image.shape == (*shape_hw, 3)
    assert decoded.image.dtype == np.uint8
    for confidence in (decoded.confidence, decoded.keypoint_confidence):
        assert confidence.shape == shape_hw
        assert confidence.dtype == np.float32
        assert 0.0 <= confidence.min() <= confidence.max() <= 1.0
    assert not decoded.outage


def test_16qam_symbols_are_points_of_the_constellation(weights):
    symbols = NeuralCodec.load(weights).encode(some_image((32, 32)), 6.0).symbols
    levels = SHAPED_SPACING * pam_levels()
    for part in (symbols.real, symbols.imag):
        assert np.abs(part[..., None] - levels).min(axis=-1).max() < 1e-6


def test_analog_symbols_have_unit_power(weights):
    symbols = NeuralCodec.load(weights, modulation="analog").encode(some_image((32, 32)), 6.0).symbols
    assert np.mean(np.abs(symbols) ** 2) == pytest.approx(1.0, rel=1e-3)


def test_the_same_input_gives_the_same_bits(weights):
    codec = NeuralCodec.load(weights)
    first, second = (codec.encode(some_image((48, 64)), 7.0) for _ in range(2))
    np.testing.assert_array_equal(first.symbols, second.symbols)
    one, two = (codec.decode(received(first, 7.0)) for _ in range(2))
    np.testing.assert_array_equal(one.image, two.image)
    np.testing.assert_array_equal(one.keypoint_confidence, two.keypoint_confidence)


def test_damaged_symbols_never_raise(weights):
    codec = NeuralCodec.load(weights)
    encoded = codec.encode(some_image((32, 32)), 7.0)
    symbols = encoded.symbols.copy()
    symbols[0, :3] = [np.nan, np.inf, 1e30]
    snr_db = np.array([np.nan, np.inf], np.float32)
    decoded = codec.decode(ReceivedImage((32, 32), symbols, snr_db, "16qam"))
    assert np.isfinite(decoded.confidence).all()
    assert np.isfinite(decoded.keypoint_confidence).all()


def test_a_slot_with_a_value_that_is_not_finite_is_a_lost_one(weights):
    codec = NeuralCodec.load(weights)
    good = received(codec.encode(some_image((32, 32)), 7.0), 7.0)
    damaged, lost = (replace(good, symbols=good.symbols.copy()) for _ in range(2))
    damaged.symbols[1, 5] = np.nan
    lost.symbols[1] = 0.0
    lost = replace(lost, effective_snr_db=np.array([7.0, LOST_SLOT_SNR_DB], np.float32))
    decoded, expected = codec.decode(damaged), codec.decode(lost)
    np.testing.assert_array_equal(decoded.confidence, expected.confidence)
    np.testing.assert_array_equal(decoded.image, expected.image)
    assert not decoded.outage
    damaged.symbols[0, 0] = np.inf
    assert codec.decode(damaged).outage


def test_a_frame_of_which_nothing_arrived_is_an_outage(weights):
    codec = NeuralCodec.load(weights)
    lost = ReceivedImage(
        (32, 32), np.zeros((2, 94), np.complex64), np.full(2, LOST_SLOT_SNR_DB, np.float32), "16qam"
    )
    assert codec.decode(lost).outage


def test_contradicting_sizes_are_refused(weights):
    codec = NeuralCodec.load(weights)
    with pytest.raises(ValueError, match="symbols must have shape"):
        codec.decode(
            ReceivedImage((32, 32), np.zeros((3, 94), np.complex64), np.zeros(2, np.float32), "16qam")
        )
    with pytest.raises(ValueError, match=r"shape_hw must be positive, got \(0, 16\)"):
        codec.encode(np.zeros((0, 16, 3), np.uint8), 10.0)
    with pytest.raises(ValueError, match="uint8"):
        codec.encode(np.zeros((16, 16, 3), np.float32), 10.0)
    with pytest.raises(ValueError, match="modulation must be"):
        codec.decode(
            ReceivedImage((32, 32), np.zeros((2, 94), np.complex64), np.zeros(2, np.float32), "analog")
        )


def test_the_digest_is_the_head_of_the_weights_sha256(weights):
    codec = NeuralCodec.load(weights)
    assert codec.digest == read_manifest(weights).sha256[:16]
    assert codec.name == "3dcsc"


def test_weights_survive_the_disk_in_half_precision(weights):
    torch.manual_seed(0)
    model, manifest = load_transceiver(weights)
    assert manifest.sizes["widths"] == [8, 8, 8]
    expected = build_3dcsc(TINY).decoder.stem.weight
    torch.testing.assert_close(model.decoder.stem.weight.shape, expected.shape)
    assert model.decoder.stem.weight.dtype == torch.float32


def change_manifest(weights, **changes):
    path = manifest_path(weights)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_changed_weights_file_is_refused(weights):
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match="sha256"):
        load_transceiver(weights)
    weights.unlink()
    with pytest.raises(CheckpointError, match=r"weights .* can't be read: .*No such file"):
        load_transceiver(weights)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"architecture": "4dcsc"}, "must be one of .*did you mean '3dcsc'"),
        ({"sizes": {"widths": [8, 8, 8]}}, "sizes of 3dcsc must be"),
        ({"format": 99}, "format 3, got 99"),
        ({"format": 1}, "format 3, got 1"),
        ({"more": 1}, "must have the keys"),
        ({"architecture": ["3dcsc"]}, "architecture in manifest .* must be str"),
        ({"sizes": 3}, "sizes in manifest .* must be dict, got 3"),
        ({"modulations": None}, "modulations in manifest .* must be list, got None"),
        ({"cbr": "1/16"}, "cbr in manifest .* must be float, got '1/16'"),
        ({"measured": []}, "measured in manifest .* must be dict"),
        ({"snr_range_db": [14.0, 0.0]}, "must be two ascending numbers"),
        ({"snr_range_db": ["low"]}, "must be two ascending numbers"),
        (
            {"sizes": {"widths": 8, "encoder_units": 1, "decoder_units": 1, "confidence_channels": 8}},
            "sizes in manifest .* make no 3dcsc",
        ),
        (
            {
                "sizes": {
                    "widths": [8, 8, 16],
                    "encoder_units": [1, 1, 1],
                    "decoder_units": [1, 1, 1],
                    "confidence_channels": 8,
                }
            },
            "must have shape",
        ),
        (
            {
                "sizes": {
                    "widths": [8, 8, 8],
                    "encoder_units": [1, 1, 2],
                    "decoder_units": [1, 1, 1],
                    "confidence_channels": 8,
                }
            },
            "names differ",
        ),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused_in_one_line(weights, changes, message):
    change_manifest(weights, **changes)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_transceiver(weights)
    assert "\n" not in str(caught.value)


def test_weights_travel_only_in_the_ways_they_are_for(weights):
    change_manifest(weights, modulations=["analog"])
    assert NeuralCodec.load(weights, "analog").modulation == "analog"
    with pytest.raises(CheckpointError, match="are for the modulation analog, got '16qam'"):
        NeuralCodec.load(weights, "16qam")


def test_missing_weights_say_what_is_shipped(tmp_path):
    with pytest.raises(CheckpointError, match="no trained weights for 'nonsense'; shipped are"):
        weights_path("nonsense")
    with pytest.raises(CheckpointError, match="no trained weights for '3dcsc-huge'"):
        NeuralCodec.load("3dcsc-huge")
    (tmp_path / "mine.pt").write_bytes(b"weights")
    with pytest.raises(CheckpointError, match="weights must be a .safetensors file, got .*mine.pt"):
        weights_path(str(tmp_path / "mine.pt"))
    with pytest.raises(CheckpointError, match="do not exist"):
        weights_path(tmp_path / "none.safetensors")


def test_too_large_weights_are_not_written(tmp_path):
    big = Sizes((300, 400, 600), (1, 1, 1), (1, 1, 1), 8)
    with pytest.raises(CheckpointError, match="<= 16777216"):
        save_transceiver(
            build_3dcsc(big),
            tmp_path / "big.safetensors",
            architecture="3dcsc",
            sizes=big,
            cbr=1 / 16,
            snr_range_db=(0.0, 14.0),
            made_by={},
        )


def test_every_registered_architecture_fits_a_weights_file():
    for name in architectures():
        with torch.device("meta"):
            model = build(name)
        assert 2 * sum(p.numel() for p in model.parameters()) <= 16 * 1024 * 1024
    with pytest.raises(CheckpointError, match="must be one of"):
        architecture("unknown")


def test_bad_settings_are_refused(weights):
    with pytest.raises(ValueError, match="num_threads must be >= 1"):
        NeuralCodec.load(weights, num_threads=0)
    with pytest.raises(CheckpointError, match="are for the modulation 16qam, analog, got 'bpsk'"):
        NeuralCodec.load(weights, modulation="bpsk")
    model, manifest = load_transceiver(weights)
    with pytest.raises(ConfigError, match="modulation must be one of 16qam, analog, got 'analogue'.*analog"):
        NeuralCodec(model, manifest, "analogue", torch.device("cpu"))


@pytest.mark.weights
def test_the_shipped_weights_load_fast_and_see_a_lost_band():
    start_s = time.process_time()
    codec = NeuralCodec.load("3dcsc-lite")
    assert time.process_time() - start_s < 10.0
    rows, columns = np.mgrid[0:128, 0:128]
    # Too fine to be guessed from the rows around: a smoother wave would be, and confidence is to say so.
    wave = (127 + 60 * np.sin(rows / 5.0) + 60 * np.sin(columns / 7.0)).astype(np.uint8)
    image = np.repeat(wave[:, :, None], 3, axis=2)
    whole = received(codec.encode(image, 10.0), 10.0)
    decoded = codec.decode(whole)
    mse = np.mean((decoded.image.astype(float) - image) ** 2)
    assert 10 * np.log10(255**2 / mse) > 24.0
    whole.symbols[3:5] = 0
    whole.effective_snr_db[3:5] = LOST_SLOT_SNR_DB
    damaged = codec.decode(whole)
    assert damaged.confidence[52:76].mean() < 0.3
    assert damaged.confidence[:32].mean() > damaged.confidence[52:76].mean() + 0.15
    assert damaged.keypoint_confidence[:32].mean() > damaged.keypoint_confidence[52:76].mean()
