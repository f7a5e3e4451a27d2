from pathlib import Path

import numpy as np
import pytest
import torch

from semcast.common.codecs import load_codec
from semcast.common.errors import ConfigError
from semcast.common.image import psnr_db
from semcast.common.nets import precision
from semcast.common.nets.int8 import has_int8
from semcast.common.nets.precision import dtype_for, has_fast_bfloat16
from semcast.common.sequence import open_sequence

PHOTOS = Path(__file__).resolve().parents[2] / "deploy/demo/kitti_06"
CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def hardware(monkeypatch):
    def choose(has_bfloat16, has_int8):
        monkeypatch.setattr(precision, "has_fast_bfloat16", lambda: has_bfloat16)
        monkeypatch.setattr(precision, "has_int8", lambda: has_int8)

    return choose


@pytest.mark.parametrize(("isa", "may_be_fast"), [("AVX2", False), ("AVX512_CORE", False), ("ALL", True)])
def test_onednn_held_to_an_instruction_set_without_bfloat16_gets_none(monkeypatch, isa, may_be_fast):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True, raising=False)
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", isa)
    assert has_fast_bfloat16() == may_be_fast


@pytest.mark.parametrize(
    ("has_bfloat16", "has_int8", "device", "can_be_int8", "chosen"),
    [
        (True, True, CPU, True, torch.bfloat16),
        (False, True, CPU, True, torch.int8),
        (False, True, CPU, False, torch.float32),
        (False, False, CPU, True, torch.float32),
        (False, True, GPU, True, torch.bfloat16),
    ],
)
def test_what_is_fast_here_is_taken(hardware, has_bfloat16, has_int8, device, can_be_int8, chosen):
    hardware(has_bfloat16, has_int8)
    assert dtype_for("auto", device, can_be_int8) == chosen


def test_a_precision_is_taken_as_told_or_refused(hardware):
    hardware(True, True)
    assert dtype_for("float32", CPU, True) == torch.float32
    assert dtype_for("int8", CPU, True) == torch.int8
    with pytest.raises(ConfigError, match="^precision must be one of auto, bfloat16, float32 for .* 'int8'$"):
        dtype_for("int8", CPU, False)
    with pytest.raises(ConfigError, match="one of auto, bfloat16, float32 for .* got 'int8'$"):
        dtype_for("int8", GPU, True)
    hardware(False, True)
    with pytest.raises(ConfigError, match="one of auto, int8, float32 for .* got 'bfloat16'$"):
        dtype_for("bfloat16", CPU, True)


@pytest.mark.weights
@pytest.mark.skipif(not has_int8(), reason="no fast convolutions of eight bits here")
def test_a_trained_codec_in_integers_loses_little():
    exact, quick = (load_codec("3dcsc-lite-vr", precision=p) for p in ("float32", "int8"))
    assert (exact.precision, quick.precision) == ("float32", "int8")
    image = open_sequence(PHOTOS).image(0)
    encoded = [codec.encode(image, 10.0) for codec in (exact, quick)]
    row_snr_db = np.full(encoded[0].symbols.shape[0], 10.0, dtype=np.float32)
    shrink = np.float32(10.0 / 11.0)
    psnr = [
        psnr_db(image, decoder.decode(sent.arrived(shrink * sent.symbols, row_snr_db)).image)
        for decoder, sent in zip((exact, quick), encoded, strict=True)
    ]
    assert psnr[0] - 0.3 < psnr[1] < psnr[0] + 0.1
    assert psnr[0] > 24.0
