"""What a run begins with, a step of it, and its checkpoint."""

import io
import json
import math
import resource
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from tiny_runs import TINY, final_state, settings_for

import semcast.common.nets.registry as registry
import semcast.training.run as run
from semcast.common.errors import CheckpointError, ConfigError, SemcastError, SourceError
from semcast.common.nets.checkpoint import load_transceiver
from semcast.common.nets.codec import NeuralCodec
from semcast.common.nets.mae import build_mae
from semcast.common.nets.manifest import read_manifest
from semcast.common.nets.transceiver import build_variable_3dcsc
from semcast.common.nets.vit import VitSizes
from semcast.training.channel import LinkDrawSettings
from semcast.training.data import CropSettings
from semcast.training.loop import train
from semcast.training.losses import LossSettings, transceiver_loss

pytestmark = pytest.mark.usefixtures("few_crops_to_fold")


@pytest.mark.parametrize("has_bfloat16", [True, False])
def test_bfloat16_is_used_where_the_hardware_has_it(
    tiny_network, photos, tmp_path, monkeypatch, has_bfloat16
):
    monkeypatch.setattr(run, "has_fast_bfloat16", lambda: has_bfloat16)
    used = []
    monkeypatch.setattr(
        run,
        "transceiver_loss",
        lambda *a: used.append(torch.is_autocast_enabled("cpu")) or transceiver_loss(*a),
    )
    result = train(settings_for(photos, tmp_path, steps=1, bf16=True))
    assert used == [has_bfloat16]
    assert read_manifest(result.weights).made_by["settings"]["bf16"] is has_bfloat16


@pytest.mark.filterwarnings("ignore:The .grad attribute:UserWarning")  # torch's own tracing looks at it
def test_a_compiled_run_equals_a_plain_one(tiny_network, photos, tmp_path, monkeypatch):
    compiled = []

    def as_written(module, *, dynamic):
        # What would be compiled, in one graph; the compiler itself takes most of a minute.
        compiled.append(type(module).__name__)
        module._compiled_call_impl = torch.compile(
            module._call_impl, dynamic=dynamic, fullgraph=True, backend="eager"
        )

    monkeypatch.setattr(torch.nn.Module, "compile", as_written)
    train(settings_for(photos, tmp_path / "compiled", compile=True))
    train(settings_for(photos, tmp_path / "plain"))
    assert compiled == ["Encoder", "Decoder"]
    states = [final_state(tmp_path / name)["model"] for name in ("compiled", "plain")]
    for name, weight in states[0].items():
        torch.testing.assert_close(weight, states[1][name])


def test_a_gradient_that_is_not_finite_spoils_nothing(tiny_network, photos, tmp_path, monkeypatch):
    real = run.transceiver_loss
    steps = []

    def once_not_finite(*args):
        steps.append(len(steps))
        loss, logs = real(*args)
        return (loss * math.inf if steps[-1] == 2 else loss), logs

    monkeypatch.setattr(run, "transceiver_loss", once_not_finite)
    train(settings_for(photos, tmp_path / "out"))
    assert len(steps) == 6
    assert all(torch.isfinite(weight).all() for weight in final_state(tmp_path / "out")["model"].values())


def test_a_run_can_begin_with_analog_links(tiny_network, photos, tmp_path):
    always_qam = LinkDrawSettings(share_16qam=1.0)
    train(settings_for(photos, tmp_path / "o", analog_share=0.5, channel=always_qam, log_every=1))
    rows = [json.loads(line) for line in (tmp_path / "o" / "log.jsonl").read_text().splitlines()]
    power = [row["power"] for row in rows if "power" in row]  # of the 16-QAM images, 0 where there is none
    assert power[:3] == [0.0, 0.0, 0.0]
    assert min(power[3:]) > 0.1


def test_a_masked_autoencoder_is_pre_trained_before_it_is_sent(photos, tmp_path, monkeypatch):
    small = VitSizes(dim=16, heads=2, encoder_depth=1, decoder_depth=1, confidence_channels=8)
    monkeypatch.setattr(registry, "_entries", lambda: (registry.Architecture("mae", small, build_mae),))
    crop = CropSettings(size_px=96)
    train(
        settings_for(
            photos,
            tmp_path / "o",
            architecture="mae",
            start="random",
            pretrain_share=0.5,
            crop=crop,
            log_every=1,
        )
    )
    rows = [json.loads(line) for line in (tmp_path / "o" / "log.jsonl").read_text().splitlines()]
    assert ["masked" in row for row in rows if "mse" in row] == [True] * 3 + [False] * 3
    codec = NeuralCodec.load(tmp_path / "o" / "mae.safetensors")
    assert codec.encode(np.zeros((64, 80, 3), np.uint8), 10.0).symbols.size == 20 * 47


def test_a_checkpoint_of_another_architecture_is_refused(tiny_network, photos, tmp_path, monkeypatch):
    train(settings_for(photos, tmp_path / "run", steps=1))
    other = registry.Architecture("other", TINY.sizes, TINY.build)
    monkeypatch.setattr(registry, "_entries", lambda: (TINY, other))
    with pytest.raises(CheckpointError, match="is of 3dcsc, not other"):
        train(settings_for(photos, tmp_path / "run", architecture="other"))


@pytest.mark.parametrize("change", ["optimiser", "only_heads"])
def test_a_checkpoint_of_other_optimisers_is_refused(change, tiny_network, photos, tmp_path):
    settings = settings_for(photos, tmp_path / "run", steps=1)
    done = train(settings)
    other = {
        "optimiser": {"optimiser": "adamw" if settings.optimiser == "muon" else "muon"},
        "only_heads": {"only_heads": True, "grow_from": done.weights},
    }[change]
    with pytest.raises(CheckpointError, match="was made with another optimiser or only_heads"):
        train(replace(settings, steps=2, **other))


def as_checkpoint(value):
    packed = io.BytesIO()
    torch.save(value, packed)
    return packed.getvalue()


@pytest.mark.parametrize("left", [b"nothing", b"hello", b"", bytes(1000), as_checkpoint([1])])
def test_a_damaged_checkpoint_is_refused(left, tiny_network, photos, tmp_path):
    (tmp_path / "last.pt").write_bytes(left)
    with pytest.raises(CheckpointError, match="can't be read"):
        train(settings_for(photos, tmp_path))


def test_a_disk_that_takes_no_more_is_one_line_and_the_checkpoint_before_stays(
    tiny_network, photos, tmp_path
):
    train(settings_for(photos, tmp_path / "out", steps=3))
    before = (tmp_path / "out" / "last.pt").read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
    try:
        with pytest.raises(SemcastError, match="training into .*out ended: .*File too large"):
            train(settings_for(photos, tmp_path / "out"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / "out" / "last.pt").read_bytes() == before


@pytest.mark.parametrize("name", ["data", "valid"])
def test_a_folder_of_images_that_is_not_there_is_named_with_its_flag(photos, tmp_path, name):
    settings = settings_for(photos, tmp_path / "out", **{name: tmp_path / "nowhere"})
    with pytest.raises(SourceError, match=f"--{name} must be a folder of images: .*nowhere can't be read"):
        train(settings)


def test_a_network_to_grow_from_must_be_there_also_where_a_checkpoint_is(tiny_network, photos, tmp_path):
    missing = tmp_path / "nowhere.safetensors"
    train(settings_for(photos, tmp_path / "old", steps=1))
    for out in (tmp_path / "new", tmp_path / "old"):
        with pytest.raises(ConfigError, match="grow_from must be a file of weights, got .*nowhere"):
            train(settings_for(photos, out, steps=1, grow_from=missing))


def test_what_a_run_could_not_do_later_is_said_before_it_begins(tiny_network, photos, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="out can't be written to .*last.pt: Not a directory"):
        train(settings_for(photos, tmp_path / "file" / "out"))
    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="device must be auto or cpu on this machine"):
            train(settings_for(photos, tmp_path / "out", device="cuda"))


def test_heads_alone_leave_every_image_as_it_is(tiny_network, photos, tmp_path):
    first = train(settings_for(photos, tmp_path / "whole", head_every=1, loss=LossSettings(confidence=1.0)))
    whole = load_transceiver(first.weights)[0].state_dict()
    heads = settings_for(photos, tmp_path / "heads", only_heads=True, grow_from=first.weights, steps=4)
    heads = replace(heads, channel=LinkDrawSettings(snr_min_db=4.0, snr_max_db=8.0))
    after = load_transceiver(train(heads).weights)[0].state_dict()
    changed = {name for name in whole if not torch.equal(whole[name], after[name])}
    assert changed == {name for name in whole if name.startswith("confidence.")}
    again = train(replace(heads, steps=8))
    assert again.steps == 8, "it goes on from its checkpoint"
    ranges_db = [read_manifest(done.weights).snr_range_db for done in (first, again)]
    assert ranges_db[0] == ranges_db[1], "to which SNRs for the encoder are clipped"
    resumed = load_transceiver(again.weights)[0].state_dict()
    assert torch.equal(whole["decoder.head.weight"], resumed["decoder.head.weight"])


def test_a_variable_rate_is_trained_from_a_fixed_one(photos, tmp_path, monkeypatch):
    variable = registry.Architecture("3dcsc-vr", TINY.sizes, build_variable_3dcsc)
    monkeypatch.setattr(registry, "_entries", lambda: (TINY, variable))
    fixed = train(settings_for(photos, tmp_path / "fixed", steps=2))
    settings = settings_for(
        photos, tmp_path / "run", architecture="3dcsc-vr", grow_from=fixed.weights, valid=photos
    )
    result = train(settings)
    assert result.valid["power"] == pytest.approx(1.0, abs=0.2)
    codec = NeuralCodec.load(result.weights)
    encoded = codec.encode(cv2.imread(str(photos / "0.png")), 10.0)
    assert encoded.symbols.shape == (6, 8 * 47)
    assert encoded.allocation
    heads = settings_for(
        photos,
        tmp_path / "heads",
        architecture="3dcsc-vr",
        only_heads=True,
        grow_from=result.weights,
        steps=2,
        loss=LossSettings(confidence=1.0),
    )
    before, after = (load_transceiver(r.weights)[0].state_dict() for r in (result, train(heads)))
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert {name.partition(".")[0] for name in changed} == {"confidence"}


def test_a_variable_rate_can_start_from_the_images_alone(photos, tmp_path, monkeypatch):
    variable = registry.Architecture("3dcsc-vr", TINY.sizes, build_variable_3dcsc)
    monkeypatch.setattr(registry, "_entries", lambda: (variable,))
    valid = shutil.copytree(photos, tmp_path / "valid")
    for k in range(6):  # enough blocks for 282 directions
        cv2.imwrite(str(photos / f"large{k}.png"), np.random.default_rng(k).integers(0, 256, (512, 512, 3)))
    settings = settings_for(photos, tmp_path / "run", architecture="3dcsc-vr", steps=2, valid=valid)
    linear = train(settings).valid["psnr_10db"]
    assert linear > train(replace(settings, start="random", out=tmp_path / "r")).valid["psnr_10db"] + 1.0
