"""A codec of variable rate: the same slots as any other, filled as the picture asks for."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import LOST_SLOT_SNR_DB, ReceivedImage
from semcast.common.codecs import load_codec
from semcast.common.nets.checkpoint import load_transceiver, save_transceiver
from semcast.common.nets.codec import NeuralCodec
from semcast.common.nets.detail import allocation_for
from semcast.common.nets.onnx_encoder import OnnxEncoder
from semcast.common.nets.transceiver import Sizes, build_3dcsc, build_variable_3dcsc
from semcast.common.phy.allocation import Allocation
from semcast.training.klt import start_from_klt
from semcast.training.onnx_export import export_encoder

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)
FACTS = {"cbr": 1 / 16, "snr_range_db": (0.0, 14.0), "made_by": {"steps": 0}, "sizes": TINY}


def pictures(count=3, seed=0):
    """Smooth on the left, full of detail on the right."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        smooth, detailed = (
            cv2.resize(rng.normal(0, 1, shape).astype(np.float32), (192, 128), interpolation=cv2.INTER_CUBIC)
            for shape in ((4, 6, 3), (64, 96, 1))
        )
        image = 128.0 + 30.0 * smooth
        image[:, 96:] += 30.0 * detailed[:, 96:, None]
        made.append(image.clip(0, 255).astype(np.uint8))
    return made


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """The best linear transceivers of these pictures, of variable and of fixed rate."""
    folder, paths = tmp_path_factory.mktemp("weights"), {}
    for name, build in (("3dcsc-vr", build_variable_3dcsc), ("3dcsc", build_3dcsc)):
        torch.manual_seed(0)
        model = build(TINY)
        start_from_klt(model, pictures(60, seed=1), torch.Generator().manual_seed(0))
        paths[name] = folder / f"{name}.safetensors"
        save_transceiver(model, paths[name], architecture=name, **FACTS)
    return paths


def error(codec, snr_db=25.0):
    """Mean squared error over a good link."""
    link, errors = Link(ChannelSettings(snr_db=snr_db), 0), []
    for k, image in enumerate(pictures()):
        decoded = codec.decode(link.carry(codec.encode(image, snr_db), 0.1 * k))
        errors.append(np.mean((decoded.image.astype(float) - image) ** 2))
    return np.mean(errors)


@pytest.mark.parametrize("way", ["16qam", "analog"])
@pytest.mark.parametrize("shape_hw", [(32, 48), (33, 47), (5, 7)])
def test_any_size_takes_the_usual_channel_uses_and_comes_back(weights, way, shape_hw):
    codec = NeuralCodec.load(weights["3dcsc-vr"], modulation=way)
    image = np.random.default_rng(0).integers(0, 256, (*shape_hw, 3), dtype=np.uint8)
    encoded = codec.encode(image, 10.0)
    rows, columns = -(-shape_hw[0] // 16), -(-shape_hw[1] // 16)
    assert encoded.symbols.shape == (rows, 47 * columns)
    assert np.mean(np.abs(encoded.symbols) ** 2) == pytest.approx(1.0, abs=0.1)
    snr_db = np.full(rows, 10.0, np.float32)
    decoded = codec.decode(encoded.arrived(encoded.symbols * np.float32(10 / 11), snr_db))
    assert decoded.image.shape == image.shape
    assert decoded.confidence.shape == shape_hw
    assert not decoded.outage


def test_pictures_with_flat_parts_come_closer_than_at_a_fixed_rate(weights):
    variable, fixed = (NeuralCodec.load(weights[name], modulation="analog") for name in ("3dcsc-vr", "3dcsc"))
    assert error(variable) < 0.8 * error(fixed)


def test_the_picture_comes_back_with_its_allocation_and_no_other(weights):
    codec, image = NeuralCodec.load(weights["3dcsc-vr"], modulation="analog"), pictures()[0]
    encoded = codec.encode(image, 25.0)
    levels = Allocation.from_code(encoded.allocation, (8, 12)).levels
    assert levels[:, 7:].min() >= levels[:, :5].max()
    assert levels[:, 7:].mean() > levels[:, :5].mean() + 1.0
    received = encoded.arrived(encoded.symbols, np.full(8, 30.0, np.float32))
    other = replace(received, allocation=Allocation(levels[:, ::-1].copy()).code)
    ours, theirs = (np.mean((codec.decode(r).image.astype(float) - image) ** 2) for r in (received, other))
    assert ours < 100
    assert theirs > 5 * ours


def test_a_lost_slot_spoils_the_rows_whose_values_it_held(weights):
    codec = NeuralCodec.load(weights["3dcsc-vr"], modulation="analog")
    image = pictures()[0]
    encoded = codec.encode(image, 25.0)
    snr_db = np.full(8, 25.0, np.float32)
    snr_db[3] = LOST_SLOT_SNR_DB
    symbols = encoded.symbols.copy()
    symbols[3] = 0
    received = encoded.arrived(symbols, snr_db)
    hit = received.row_snr_db < 24.0
    assert hit[3]
    assert 1 <= hit.sum() <= 3
    errors = np.abs(codec.decode(received).image.astype(float) - image).reshape(8, 16, -1).mean(axis=(1, 2))
    assert errors[3] > 2 * np.median(errors[~hit])
    assert errors[~hit].max() < errors[3]


@pytest.mark.parametrize("way", ["16qam", "analog"])
def test_what_is_in_a_lost_slot_is_not_made_louder(weights, way):
    """Blocks that are partly lost are no further from the original than one grey would be."""
    codec = NeuralCodec.load(weights["3dcsc-vr"], modulation=way)
    for image in pictures(1):
        encoded = codec.encode(image, 25.0)
        for lost in range(8):
            snr_db = np.full(8, 25.0, np.float32)
            snr_db[lost] = LOST_SLOT_SNR_DB
            symbols = encoded.symbols.copy()
            symbols[lost] = 0
            decoded = codec.decode(encoded.arrived(symbols, snr_db)).image.astype(float)
            blocks = np.square(decoded - image).reshape(8, 16, 12, 16, 3).mean(axis=(1, 3, 4))
            grey = np.square(128.0 - image).reshape(8, 16, 12, 16, 3).mean(axis=(1, 3, 4))
            assert (blocks < 2.0 * grey + 400.0).all()


def test_a_frame_of_which_nothing_arrived_needs_no_code(weights):
    codec = NeuralCodec.load(weights["3dcsc-vr"])
    nothing = ReceivedImage(
        (32, 32), np.zeros((2, 94), np.complex64), np.full(2, LOST_SLOT_SNR_DB, np.float32), "16qam"
    )
    assert codec.decode(nothing).outage
    np.testing.assert_array_equal(nothing.row_snr_db, nothing.effective_snr_db)


def test_codes_that_do_not_fit_are_refused(weights):
    variable, fixed = (NeuralCodec.load(weights[name]) for name in ("3dcsc-vr", "3dcsc"))
    encoded = variable.encode(pictures()[0], 10.0)
    received = encoded.arrived(encoded.symbols, np.full(8, 10.0, np.float32))
    with pytest.raises(ValueError, match="allocation must be empty for a codec of fixed rate"):
        fixed.decode(received)
    for code in (b"\xff", b""):
        with pytest.raises(ValueError, match="allocation must be the code of 8x12 blocks"):
            variable.decode(replace(received, allocation=code))
    conventional = load_codec("jpeg-ldpc")
    with pytest.raises(ValueError, match="allocation must be empty for a codec of fixed rate"):
        conventional.decode(received)


@pytest.mark.parametrize("way", ["16qam", "analog"])
def test_the_exported_encoder_sends_the_same(weights, tmp_path, way):
    path = export_encoder(weights["3dcsc-vr"], tmp_path / "vr.onnx")
    image = pictures()[1]
    ours = OnnxEncoder(path, way, 1).encode(image, 8.0)
    model = load_transceiver(weights["3dcsc-vr"])[0]  # in full precision
    allocation = allocation_for(image)
    assert ours.allocation == allocation.code
    is_qam = torch.tensor([float(way == "16qam")])
    values = torch.from_numpy(allocation.values)[None, None]
    x = torch.from_numpy(image)[None].permute(0, 3, 1, 2).float() / 255.0
    with torch.inference_mode():
        latent = model.latent(x, torch.tensor([8.0]), is_qam, values)
        expected = model.transmit(latent, is_qam, values)[0].permute(1, 2, 0).reshape(8, -1).numpy()
    sent = ours.symbols.view(np.float32).reshape(8, -1)
    assert (np.abs(sent - expected) > 2e-3).mean() < 0.002
