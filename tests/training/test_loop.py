import contextlib
import io
import json
import math
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import semcast.common.nets.registry as registry
import semcast.training.loop as loop
from semcast.common.config import build_settings, read_toml
from semcast.common.errors import CheckpointError, ConfigError, SemcastError, SourceError
from semcast.common.nets.checkpoint import load_transceiver
from semcast.common.nets.codec import NeuralCodec
from semcast.common.nets.mae import build_mae
from semcast.common.nets.manifest import read_manifest
from semcast.common.nets.registry import architectures
from semcast.common.nets.transceiver import Sizes, build_3dcsc, build_variable_3dcsc
from semcast.common.nets.vit import VitSizes
from semcast.training.centring import folded
from semcast.training.channel import LinkDrawSettings
from semcast.training.data import CropSettings
from semcast.training.loop import train
from semcast.training.losses import LossSettings, transceiver_loss
from semcast.training.optimisers import rate_factor
from semcast.training.settings import TrainSettings

TINY = registry.Architecture("3dcsc", Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8), build_3dcsc)


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(4):
        small = rng.integers(0, 256, size=(12, 16, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.resize(small, (128, 96), interpolation=cv2.INTER_CUBIC))
    return folder


@pytest.fixture(autouse=True)
def few_crops_to_fold(monkeypatch):
    """Passing as many as a real run does takes longer than the few steps of these."""
    monkeypatch.setattr(loop, "_FOLD_BATCHES", 2)


@pytest.fixture
def tiny_network(monkeypatch):
    """Register the smallest real network under the name of the main one."""
    monkeypatch.setattr(registry, "_entries", lambda: (TINY,))


def settings_for(photos, out, **changes):
    values = {
        "architecture": "3dcsc",
        "data": photos,
        "out": out,
        "batch": 2,
        "steps": 6,
        "warmup_steps": 2,
        "head_every": 2,
        "log_every": 2,
        "save_every": 3,
        "bf16": False,
        "device": "cpu",
        "crop": CropSettings(size_px=32),
    }
    return TrainSettings(**(values | changes))


def final_state(out):
    return torch.load(out / "last.pt", weights_only=True)


def test_a_run_leaves_weights_the_codec_can_use(tiny_network, photos, tmp_path):
    reports = []
    result = train(settings_for(photos, tmp_path / "run", valid=photos), reports.append)
    assert result.steps == 6
    assert [r.step for r in reports] == [1, 2, 4, 6], "the first step shows that it runs"
    assert {"psnr_2db", "psnr_6db", "psnr_10db", "power"} == set(result.valid)
    codec = NeuralCodec.load(result.weights)
    assert codec.encode(np.zeros((32, 32, 3), np.uint8), 10.0).symbols.shape == (2, 94)
    assert codec.manifest.made_by["steps"] == 6
    assert codec.manifest.made_by["samples"] == 12
    assert str(tmp_path) not in json.dumps(codec.manifest.made_by)
    rows = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "loss" in row] == [2, 4, 6]


@pytest.mark.parametrize("has_bfloat16", [True, False])
def test_bfloat16_is_used_where_the_hardware_has_it(
    tiny_network, photos, tmp_path, monkeypatch, has_bfloat16
):
    monkeypatch.setattr(loop, "has_fast_bfloat16", lambda: has_bfloat16)
    used = []
    monkeypatch.setattr(
        loop,
        "transceiver_loss",
        lambda *a: used.append(torch.is_autocast_enabled("cpu")) or transceiver_loss(*a),
    )
    result = train(settings_for(photos, tmp_path, steps=1, bf16=True))
    assert used == [has_bfloat16]
    assert read_manifest(result.weights).made_by["settings"]["bf16"] is has_bfloat16


def test_hidden_units_are_folded_once_at_the_end(tiny_network, photos, tmp_path, monkeypatch):
    """It takes as long as dozens of steps."""
    folds = []
    monkeypatch.setattr(loop, "folded", lambda *a: folds.append(a) or folded(*a))
    train(settings_for(photos, tmp_path, steps=1, valid=photos))
    assert len(folds) == 1
    train(settings_for(photos, tmp_path / "run", steps=4, valid=photos, valid_every=2))
    assert len(folds) == 3, "one half way"
    rows = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "valid" in row] == [2, 4]


def test_a_resumed_run_equals_one_without_a_break(tiny_network, photos, tmp_path):
    train(settings_for(photos, tmp_path / "whole"))
    asked = iter([False, False, False, True])
    first = train(settings_for(photos, tmp_path / "broken"), should_stop=lambda: next(asked))
    assert first.steps == 3
    train(settings_for(photos, tmp_path / "broken"))
    whole, broken = final_state(tmp_path / "whole"), final_state(tmp_path / "broken")
    for part in ("model", "average"):
        for name, tensor in whole[part].items():
            torch.testing.assert_close(broken[part][name], tensor, rtol=0, atol=0, msg=name)


def test_the_curve_of_a_run_that_was_killed_has_each_step_once(tiny_network, photos, tmp_path):
    asked = iter([False, False, False, True])
    train(settings_for(photos, tmp_path), should_stop=lambda: next(asked))
    # What it would have reported after its last checkpoint, and was killed in.
    # And another time before, when the next row was added to half a one.
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 4, "lo{"step": 4, "loss": 8.0}\n{"step": 4, "loss": 9.0}\n{"step": 6, "lo')
    train(settings_for(photos, tmp_path))
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4, 6]
    assert rows[1]["loss"] != 9.0


def test_a_finished_run_that_is_run_again_has_its_validation_once(tiny_network, photos, tmp_path):
    settings = settings_for(photos, tmp_path, steps=2, valid=photos)
    train(settings)
    once = (tmp_path / "log.jsonl").read_text()
    train(settings)
    assert (tmp_path / "log.jsonl").read_text() == once


def test_the_weights_change_and_the_seed_decides_how(tiny_network, photos, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(settings_for(photos, tmp_path / name, steps=2, seed=seed))
    a, b, c = (final_state(tmp_path / name)["model"]["decoder.stem.weight"] for name in "abc")
    torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert not torch.equal(a, c)


def test_training_lowers_the_loss_on_the_images_it_sees(tiny_network, photos, tmp_path):
    reports = []
    rates = {"lr": 1e-2, "lr_linear": 1e-2, "clip": 1.0}
    clean = LinkDrawSettings(snr_min_db=14.0, share_faded=0.0, share_lossy=0.0)
    train(
        settings_for(
            photos, tmp_path / "run", steps=80, log_every=20, start="random", channel=clean, **rates
        ),
        reports.append,
    )
    assert reports[-1].values["mse"] < 0.8 * reports[0].values["mse"]


@pytest.mark.parametrize("changes", [{"optimiser": "adamw"}, {"loss": LossSettings(descriptor=0.01)}])
def test_other_optimisers_and_terms_run(tiny_network, photos, tmp_path, changes):
    assert train(settings_for(photos, tmp_path / "run", steps=2, **changes)).steps == 2


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
    real = loop.transceiver_loss
    steps = []

    def once_not_finite(*args):
        steps.append(len(steps))
        loss, logs = real(*args)
        return (loss * math.inf if steps[-1] == 2 else loss), logs

    monkeypatch.setattr(loop, "transceiver_loss", once_not_finite)
    train(settings_for(photos, tmp_path / "out"))
    assert len(steps) == 6
    assert all(torch.isfinite(weight).all() for weight in final_state(tmp_path / "out")["model"].values())


def test_losses_that_stay_not_finite_end_a_run_and_its_sound_checkpoint_stays(
    tiny_network, photos, tmp_path, monkeypatch
):
    real = loop.transceiver_loss
    steps = []

    def finite_no_longer(*args):
        steps.append(len(steps) + 1)
        loss, logs = real(*args)
        return (loss * math.nan if steps[-1] > 7 else loss), logs

    monkeypatch.setattr(loop, "transceiver_loss", finite_no_longer)
    with pytest.raises(SemcastError) as raised:
        train(settings_for(photos, tmp_path, steps=100))
    message = (
        r"broke down by step 18: the last 11 losses are not finite, the last finite loss was [\d.]+ in step 7"
    )
    assert re.search(message, str(raised.value))
    assert str(raised.value).endswith("; the checkpoint of step 6 stays")
    assert final_state(tmp_path)["step"] == 6
    assert not (tmp_path / "3dcsc.safetensors").exists()


def test_weights_that_half_precision_has_no_room_for_end_a_run(tiny_network, photos, tmp_path):
    with pytest.raises(SemcastError, match="broke down by step 2: weights are not finite in half precision"):
        train(settings_for(photos, tmp_path, lr=1e30, warmup_steps=0))
    assert not list(tmp_path.glob("*.safetensors")) + list(tmp_path.glob("*.pt"))


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


def test_the_rate_warms_up_stays_and_falls_to_zero():
    settings = TrainSettings(warmup_steps=10, decay_share=0.25)
    assert rate_factor(0.0, 0, settings) == pytest.approx(0.1)
    assert rate_factor(0.5, 500, settings) == 1.0
    assert rate_factor(0.875, 500, settings) == pytest.approx(0.5)
    assert rate_factor(1.0, 500, settings) == 0.0


def test_settings_are_checked():
    with pytest.raises(ValueError, match="batch must be >= 1, got 0"):
        TrainSettings(batch=0)
    with pytest.raises(ValueError, match="lr must be > 0"):
        TrainSettings(lr=0.0)
    for values in (
        {"lr": math.nan},
        {"clip": math.inf},
        {"minutes": math.nan},
        {"seed": -1},
        {"seed": 2**40},
    ):
        with pytest.raises(ValueError, match=next(iter(values)) + " must be"):
            TrainSettings(**values)


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


def test_heads_alone_need_a_network_and_a_loss(tmp_path):
    with pytest.raises(ValueError, match="grow_from must name the weights"):
        TrainSettings(only_heads=True)
    with pytest.raises(ValueError, match="confidence must be > 0 when only_heads is set"):
        TrainSettings(only_heads=True, grow_from=tmp_path, loss=LossSettings(confidence=0.0))


def test_every_shipped_settings_file_is_valid():
    folder = Path(registry.__file__).resolve().parents[2] / "training"
    files = sorted(folder.glob("*.toml"))
    assert "3dcsc-lite" in {f.stem for f in files}
    for file in files:
        settings = build_settings(TrainSettings, read_toml(file))
        assert settings.architecture == file.stem or file.stem in ("heads", "variable")  # for several
        assert settings.architecture in architectures()


_WORKER = """
import os, sys
from pathlib import Path
import torch
import semcast.common.nets.registry as registry
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.training import loop
from semcast.training.data import CropSettings
from semcast.training.settings import TrainSettings
torch.set_num_threads(1)
loop._FOLD_BATCHES = 2
sizes = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)
registry._entries = lambda: (registry.Architecture("3dcsc", sizes, build_3dcsc),)
runs = (("whole", 2, None), ("first", 1000, "0"), ("second", 1000, "1"))
for (name, steps, stopped_rank), port in zip(runs, sys.argv[3:], strict=True):
    os.environ["MASTER_PORT"] = port  # one may still be leaving the last run when the other joins the next
    settings = TrainSettings(architecture="3dcsc", data=Path(sys.argv[1]), out=Path(sys.argv[2]) / name,
                             batch=2, steps=steps, bf16=False, device="cpu", crop=CropSettings(size_px=32))
    loop.train(settings, should_stop=lambda: os.environ["RANK"] == stopped_rank)
"""


def test_two_processes_train_one_model_and_stop_together_when_one_is_told_to(photos, tmp_path):
    with contextlib.ExitStack() as held:
        free = [held.enter_context(socket.socket()) for _ in range(3)]
        for one in free:
            one.bind(("127.0.0.1", 0))
        ports = [str(one.getsockname()[1]) for one in free]
    link = {"MASTER_ADDR": "127.0.0.1", "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", _WORKER, str(photos), str(tmp_path), *ports],
            env=os.environ | link | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
        )
        for rank in (0, 1)
    ]
    assert [process.wait(timeout=200) for process in started] == [0, 0]
    whole, first, second = (
        json.loads((tmp_path / name / "3dcsc.json").read_text())["made_by"]
        for name in ("whole", "first", "second")
    )
    assert (whole["processes"], whole["steps"], whole["samples"]) == (2, 2, 8)
    assert first["steps"] == second["steps"] == 1
