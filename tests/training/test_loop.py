import contextlib
import json
import math
import os
import re
import socket
import subprocess
import sys

import numpy as np
import pytest
import torch
from tiny_runs import final_state, settings_for

import semcast.training.run as run
from semcast.common.errors import SemcastError
from semcast.common.nets.codec import NeuralCodec
from semcast.training.centring import folded
from semcast.training.channel import LinkDrawSettings
from semcast.training.loop import train
from semcast.training.losses import LossSettings

pytestmark = pytest.mark.usefixtures("few_crops_to_fold")


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


def test_hidden_units_are_folded_once_at_the_end(tiny_network, photos, tmp_path, monkeypatch):
    """It takes as long as dozens of steps."""
    folds = []
    monkeypatch.setattr(run, "folded", lambda *a: folds.append(a) or folded(*a))
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


def test_losses_that_stay_not_finite_end_a_run_and_its_sound_checkpoint_stays(
    tiny_network, photos, tmp_path, monkeypatch
):
    real = run.transceiver_loss
    steps = []

    def finite_no_longer(*args):
        steps.append(len(steps) + 1)
        loss, logs = real(*args)
        return (loss * math.nan if steps[-1] > 7 else loss), logs

    monkeypatch.setattr(run, "transceiver_loss", finite_no_longer)
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


_WORKER = """
import os, sys
from pathlib import Path
import torch
import semcast.common.nets.registry as registry
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.training import loop, run
from semcast.training.data import CropSettings
from semcast.training.settings import TrainSettings
torch.set_num_threads(1)
run._FOLD_BATCHES = 2
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
