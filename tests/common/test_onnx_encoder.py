"""The exported encoder sends what the torch encoder sends, and needs no torch."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch

from semcast.common.codecs import load_codec
from semcast.common.errors import CheckpointError, ConfigError, SourceError
from semcast.common.nets import modulation, modulation_numpy
from semcast.common.nets.checkpoint import load_transceiver, save_transceiver
from semcast.common.nets.latent import symbols_from_latent
from semcast.common.nets.manifest import read_manifest, weights_path
from semcast.common.nets.onnx_encoder import OnnxEncoder, encoder_path
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.common.nets.vit import VitSizes, build_vit
from semcast.training import onnx_int8
from semcast.training.onnx_export import export_encoder

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    model = build_3dcsc(TINY)
    with torch.no_grad():
        model.encoder.linear.transform.weight.mul_(20.0)
        for layer in (model.encoder.head, model.encoder.stage16.attention.excite):
            layer.weight.normal_()  # so that SNR and modulation matter
    facts = {"architecture": "3dcsc", "sizes": TINY, "cbr": 1 / 16, "snr_range_db": (0.0, 14.0)}
    save_transceiver(model, path, made_by={"steps": 0}, **facts)
    return path


@pytest.fixture(scope="module")
def exported(weights):
    return export_encoder(weights, weights.with_suffix(".onnx"))


def some_image(shape_hw):
    return np.random.default_rng(0).integers(0, 256, size=(*shape_hw, 3), dtype=np.uint8)


def in_full_precision(weights, image, snr_db, way):
    """The torch encoder's symbols without bfloat16."""
    model, _ = load_transceiver(weights)
    is_qam = torch.tensor([float(way == "16qam")])
    x = torch.from_numpy(image)[None].permute(0, 3, 1, 2).float() / 255.0
    with torch.inference_mode():
        latent = model.latent(x, torch.tensor([snr_db]), is_qam)
        return symbols_from_latent(model.transmit(latent, is_qam)[0].numpy())


@pytest.mark.parametrize("way", ["16qam", "analog"])
@pytest.mark.parametrize("shape_hw", [(32, 48), (64, 160)])
def test_it_sends_what_torch_sends(weights, exported, way, shape_hw):
    image = some_image(shape_hw)
    for snr_db in (2.0, 12.0):
        encoded = OnnxEncoder(exported, way, 1).encode(image, snr_db)
        expected = in_full_precision(weights, image, snr_db, way)
        assert encoded.symbols.dtype == np.complex64
        different = np.abs(encoded.symbols - expected) > 1e-3
        assert different.mean() < 0.001  # a value on the edge of a level may fall to either side


def test_the_expected_snr_is_heard(exported):
    codec, image = OnnxEncoder(exported, "analog"), some_image((32, 48))
    assert not np.allclose(codec.encode(image, 0.0).symbols, codec.encode(image, 14.0).symbols, atol=1e-4)
    # Outside the trained range it is clipped, and what is no number counts as the worst link.
    np.testing.assert_array_equal(codec.encode(image, 99.0).symbols, codec.encode(image, 14.0).symbols)
    np.testing.assert_array_equal(codec.encode(image, np.nan).symbols, codec.encode(image, 0.0).symbols)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads its memory from /proc")
def test_memory_is_not_planned_ahead_for_every_size_of_images():
    code = (
        "import numpy as np\n"
        "from semcast.common.codecs import load_codec\n"
        "codec = load_codec('3dcsc-lite-vr', runtime='onnx', num_threads=1)\n"
        "def peak_kb(): return int(open('/proc/self/status').read().partition('VmHWM:')[2].split()[0])\n"
        "before_kb = peak_kb()\n"
        "for rows in (640, 640, 672, 672):\n"
        "    codec.encode(np.zeros((rows, 1024, 3), np.uint8), 8.0)\n"
        "print((peak_kb() - before_kb) // 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 90


def test_any_size_is_padded_to_whole_blocks(exported):
    encoded = OnnxEncoder(exported).encode(some_image((33, 47)), 10.0)
    assert encoded.shape_hw == (33, 47)
    assert encoded.symbols.shape == (3, 47 * 3)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for k in range(4):
        image = cv2.GaussianBlur(np.random.default_rng(k).integers(0, 256, (96, 128, 3), np.uint8), None, 3.0)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX))
    return folder


def test_eight_bit_convolutions_hardly_change_the_latent(photos, tmp_path):
    # The shipped network: one at random may amplify anything.
    image = cv2.imread(str(photos / "0.png"))
    plain = export_encoder("3dcsc-lite", tmp_path / "plain.onnx")
    small = export_encoder("3dcsc-lite", tmp_path / "small.onnx", photos)
    assert small.stat().st_size < 0.7 * plain.stat().st_size
    encoders = [OnnxEncoder(path, "analog", 1) for path in (plain, small)]
    assert encoders[0].digest == encoders[1].digest
    exact, rounded = (encoder.encode(image, 10.0).symbols for encoder in encoders)
    error = np.mean(np.abs(rounded - exact) ** 2)
    assert 0.0 < error < 0.003  # the noise of a link of 10 dB is 0.1


def test_ranges_are_learned_from_photos_of_the_whole_folder(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(onnx_int8, "quantize_static", lambda source, out, ranges, **how: seen.append(ranges))
    plain = export_encoder("3dcsc-lite", tmp_path / "plain.onnx")
    onnx_int8.quantise(plain, [], [np.full((32, 32, 3), k, np.uint8) for k in range(95)], (0.0, 14.0))
    photos = [int(given["image"][0, 0, 0, 0]) for given in iter(seen[0].get_next, None)]
    assert len(photos) == 48
    assert max(np.diff([-1, *photos, 95])) <= 2


def test_eight_bits_need_photos(weights, tmp_path):
    with pytest.raises(SourceError, match="nothing can't be read: .*No such file"):
        export_encoder(weights, tmp_path / "out.onnx", tmp_path / "nothing")
    cv2.imwrite(str(tmp_path / "tiny.png"), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(SourceError, match="sides of at least 32 pixels, .*tiny.png is 8x8"):
        export_encoder(weights, tmp_path / "out.onnx", tmp_path)
    assert not (tmp_path / "out.onnx").exists()


def test_a_transformer_is_not_exported_with_the_windows_of_one_size(tmp_path):
    sizes = VitSizes(dim=16, heads=2, encoder_depth=1, decoder_depth=1, window=2, confidence_channels=8)
    facts = {"architecture": "vit", "sizes": sizes, "cbr": 1 / 16, "snr_range_db": (0.0, 14.0)}
    weights = tmp_path / "tiny.safetensors"
    save_transceiver(build_vit(sizes), weights, made_by={"steps": 0}, **facts)
    with pytest.raises(ConfigError, match="must be of an encoder of convolutions, got vit, .* needs torch"):
        export_encoder(weights, tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()


@pytest.mark.parametrize("way", ["16qam", "analog"])
def test_modulation_without_torch_is_the_same(way):
    latent = np.random.default_rng(0).normal(0, 0.9, (94, 4, 7)).astype(np.float32)
    is_qam = torch.tensor([float(way == "16qam")])
    expected = modulation.modulate(torch.from_numpy(latent)[None], is_qam)[0].numpy()
    different = np.abs(modulation_numpy.transmit(latent, way) - expected) > 2e-6
    assert different.mean() < 0.001  # a value on the edge of a level may fall to either side


def test_it_can_not_decode_and_says_who_can(exported):
    with pytest.raises(ConfigError, match="a server needs torch"):
        OnnxEncoder(exported).decode(None)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((32, 32), np.uint8), "image"),
        (np.zeros((32, 32, 3), np.float32), "image must be uint8"),
        (np.zeros((0, 32, 3), np.uint8), "shape_hw must be positive"),
    ],
)
def test_bad_images_are_refused(exported, image, message):
    with pytest.raises(ValueError, match=message):
        OnnxEncoder(exported).encode(image, 10.0)


def test_bad_files_are_one_clear_error(exported, tmp_path):
    with pytest.raises(
        CheckpointError, match=re.escape(f"there is no exported encoder {tmp_path}/nothing.onnx")
    ):
        OnnxEncoder(tmp_path / "nothing.onnx")
    with pytest.raises(CheckpointError, match="no exported encoder vit.onnx; write one with 'semcast onnx'"):
        OnnxEncoder("vit")
    (tmp_path / "cut.onnx").write_bytes(exported.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="can't be read"):
        OnnxEncoder(tmp_path / "cut.onnx")
    other = onnx.load(str(exported))
    onnx.helper.set_model_props(other, {"semcast_format": "99"})
    onnx.save(other, str(tmp_path / "other.onnx"))
    with pytest.raises(CheckpointError, match="must have format 2 or 3, got 99"):
        OnnxEncoder(tmp_path / "other.onnx")
    del other.metadata_props[:]
    onnx.helper.set_model_props(other, {"semcast_format": "2", "architecture": "3dcsc", "digest": "ab"})
    onnx.save(other, str(tmp_path / "other.onnx"))
    with pytest.raises(CheckpointError, match="does not say its 'snr_min_db'"):
        OnnxEncoder(tmp_path / "other.onnx")
    with pytest.raises(ValueError, match="num_threads must be >= 1, got 0"):
        OnnxEncoder(exported, num_threads=0)


@pytest.mark.weights
def test_the_shipped_encoder_belongs_to_the_shipped_weights():
    manifest = read_manifest(weights_path("3dcsc-lite"))
    encoder = OnnxEncoder(encoder_path("3dcsc-lite"))
    assert encoder.digest == manifest.sha256[:16], (
        "run: semcast onnx 3dcsc-lite --out common/weights/3dcsc-lite.onnx"
    )
    assert encoder.name == "3dcsc-lite"
    assert load_codec("3dcsc-lite", runtime="onnx").digest == encoder.digest


@pytest.mark.weights
def test_an_agent_starts_and_encodes_without_torch():
    code = """
import sys
for name in ("torch", "gtsam", "rerun", "poselib", "mcap", "matplotlib", "onnx"):
    sys.modules[name] = None
import numpy as np
import semcast.commands.agent
from semcast.common.codecs import load_codec
codec = load_codec("3dcsc-lite", num_threads=1, runtime="auto")
symbols = codec.encode(np.full((48, 64, 3), 90, np.uint8), 10.0).symbols
print(type(codec).__name__, symbols.shape, bool(abs(np.mean(abs(symbols) ** 2) - 1.0) < 0.6))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[0] == "OnnxEncoder (3, 188) True"


def test_without_any_runtime_the_message_says_what_to_install():
    code = """
import sys
sys.modules["torch"] = sys.modules["onnxruntime"] = None
from semcast.common.codecs import load_codec
load_codec("3dcsc-lite", runtime="auto")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "semcast[edge]" in done.stderr.splitlines()[-1]


def test_weights_without_torch_are_one_line_that_says_how_to_go_on(weights, tmp_path):
    weights = shutil.copy(weights, tmp_path / "mine.safetensors")
    code = f"""
import sys
sys.modules["torch"] = None
from semcast.cli import main
sys.exit(main(["agent", "--source", "nowhere", "--weights", {str(weights)!r}]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    encoder = weights.with_suffix(".onnx")
    assert done.stderr == (
        f"semcast agent: no exported encoder {encoder} beside the weights, which sending without torch "
        "needs: install torch (semcast[agent]) or, where it is installed, have it written: "
        f"semcast onnx {weights} --out {encoder}\n"
    )
    assert done.returncode == 1


def test_an_export_that_is_stopped_leaves_the_encoder_that_was_there(weights, tmp_path, monkeypatch):
    def stopped(graph):
        raise KeyboardInterrupt

    out = tmp_path / "mine.onnx"
    out.write_bytes(b"the one before")
    monkeypatch.setattr("semcast.training.onnx_export.halve_weights", stopped)
    with pytest.raises(KeyboardInterrupt):
        export_encoder(weights, out)
    assert out.read_bytes() == b"the one before"
    assert [path.name for path in tmp_path.iterdir()] == ["mine.onnx"]
