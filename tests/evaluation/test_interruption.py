"""Ctrl-C or SIGTERM in the middle of a measurement: what was finished is written, marked, and shown."""

import json
import os
import signal
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from semcast.cli import main
from semcast.commands.evaluate import EVALUATIONS
from semcast.evaluation import endurance, runtime, trajectory
from semcast.evaluation.codec import CodecSettings, evaluate_codec
from semcast.evaluation.confidence import ConfidenceSettings, evaluate_confidence
from semcast.evaluation.depth import DepthSettings, evaluate_depth
from semcast.evaluation.endurance import EnduranceSettings, evaluate_endurance
from semcast.evaluation.interruption import InterruptedMeasurementError, until_interrupted
from semcast.evaluation.pairs import PairSettings, evaluate_pairs
from semcast.evaluation.runtime import RuntimeSettings, evaluate_runtime
from semcast.evaluation.trajectory import TrajectorySettings, evaluate_trajectory


@pytest.fixture
def interrupted(phase_codec, monkeypatch):
    """Makes a codec while whose n-th image is decoded somebody sends a signal."""

    def make(n, number=signal.SIGINT):
        decode = phase_codec.decode

        def interrupted_decode(received):
            if phase_codec.num_decoded == n - 1:
                os.kill(os.getpid(), number)
            return decode(received)

        monkeypatch.setattr(phase_codec, "decode", interrupted_decode)
        return phase_codec

    return make


@pytest.fixture
def images(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(2):
        noise = np.random.default_rng(k).uniform(0, 255, (64, 96, 3))
        cv2.imwrite(str(folder / f"{k}.png"), cv2.GaussianBlur(noise, (0, 0), 5.0))
    return folder


def left_of(evaluate, settings, *codec):
    """The result of a measurement that is interrupted: what is in a file of its own."""
    with pytest.raises(KeyboardInterrupt) as caught:  # any other would end the tests
        evaluate(settings, *codec)
    assert caught.type is InterruptedMeasurementError
    partial = settings.json.with_name("r.partial.json")
    assert caught.value.path == partial
    assert not settings.json.exists()
    assert json.loads(partial.read_text()) == caught.value.result
    assert caught.value.result["partial"] is True
    return caught.value.result


def test_a_trajectory_keeps_its_finished_seeds_and_modes(room, interrupted, tmp_path):
    settings = TrajectorySettings(
        sequence=room,
        codec="phase",
        snr_db=(20.0, 15.0),
        seeds=2,
        confidence=("robust", "off"),
        max_frames=3,
        rows=False,
        json=tmp_path / "r.json",
        out=tmp_path,
    )
    report = left_of(evaluate_trajectory, settings, interrupted(3 * 3 + 2))
    assert [(cell["snr_db"], cell["confidence"], cell["seeds"]) for cell in report["cells"]] == [
        (20.0, "robust", [0, 1]),
        (20.0, "off", [0, 1]),
        (15.0, "robust", [0]),
        (15.0, "off", [0]),
    ]


def test_a_trajectory_is_compared_over_the_seeds_that_both_modes_have(
    room, phase_codec, tmp_path, monkeypatch
):
    settings = TrajectorySettings(
        sequence=room,
        codec="phase",
        snr_db=(20.0,),
        seeds=2,
        confidence=("robust", "off"),
        max_frames=3,
        json=tmp_path / "r.json",
    )
    keep, calls = trajectory.reconstruct, []

    def reconstruct(*arguments):
        calls.append(arguments)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return keep(*arguments)

    monkeypatch.setattr(trajectory, "reconstruct", reconstruct)
    report = left_of(evaluate_trajectory, settings, phase_codec)
    assert [cell["seeds"] for cell in report["cells"]] == [[0, 1], [0]]
    (comparison,) = report["comparisons"]
    assert comparison["num_left_out"] == 2, "none has a path, and one has no rival"


def test_pairs_keep_every_pair(room, interrupted, tmp_path):
    settings = PairSettings(
        sequence=room,
        codec="phase",
        snr_db=(20.0, 15.0),
        max_frames=4,
        gap=(2, 1),
        competitors=False,
        json=tmp_path / "r.json",
    )
    report = left_of(evaluate_pairs, settings, interrupted(4 + 2))
    pairs = [(c["snr_db"], c["gap"], c["results"]["robust"]["num_pairs"]) for c in report["cells"]]
    assert pairs == [(20.0, 2, 2), (20.0, 1, 3)]


def test_pairs_of_a_seed_that_is_not_finished_are_kept_and_not_compared(room, interrupted, tmp_path):
    settings = PairSettings(
        sequence=room,
        codec="phase",
        snr_db=(20.0,),
        seeds=3,
        max_frames=4,
        competitors=False,
        json=tmp_path / "r.json",
    )
    report = left_of(evaluate_pairs, settings, interrupted(2 * 4 + 3))
    (cell,) = report["cells"]
    assert cell["results"]["robust"]["num_pairs"] == report["results"]["robust"]["num_pairs"] == 2 * 3 + 1
    assert cell["comparisons"][0]["paired"]["num_samples"] == 3


@pytest.mark.parametrize(
    ("evaluate", "cls", "num_before", "given"),
    [
        (evaluate_codec, CodecSettings, 1 + 2, {"codec": ("phase",)}),
        (evaluate_confidence, ConfidenceSettings, 4, {"codec": "phase", "max_frames": 4}),
        (evaluate_depth, DepthSettings, 6, {"codec": ("phase",), "max_frames": 10, "confidence": ("off",)}),
    ],
)
def test_results_over_snr_keep_the_finished_rows(
    evaluate, cls, num_before, given, room, images, interrupted, tmp_path
):
    source = {"images": images} if evaluate is evaluate_codec else {"sequence": room}
    settings = cls(**source, snr_db=(20.0, 15.0), json=tmp_path / "r.json", **given)
    codec = interrupted(num_before + 1)
    codec = codec if evaluate is evaluate_confidence else [codec]
    report = left_of(evaluate, settings, codec)
    assert [row["snr_db"] for row in report["results"]] == [20.0]


def test_a_long_run_keeps_its_rows(room, tmp_path, caplog):
    caplog.set_level("INFO", endurance.logger.name)
    settings = EnduranceSettings(
        sequence=room, codec="none", max_frames=3, frames=9, every=3, json=tmp_path / "r.json"
    )

    def interrupts(record):
        if record.getMessage().startswith("6 of 9"):
            raise KeyboardInterrupt
        return True

    endurance.logger.addFilter(interrupts)
    try:
        report = left_of(evaluate_endurance, settings)
    finally:
        endurance.logger.removeFilter(interrupts)
    assert [row["frames"] for row in report["results"]] == [3, 6]


def test_runtimes_keep_the_times_of_finished_rounds(tmp_path, monkeypatch):
    class Child(SimpleNamespace):
        def __init__(self, variant, _):
            super().__init__(variant=variant, times_ms=[], error=None, precision="float32")

        def turn(self, calls):
            if len(self.times_ms) == 2 * calls:
                raise KeyboardInterrupt
            self.times_ms += [5.0] * calls

        def close(self):
            pass

    monkeypatch.setattr(runtime, "_Child", Child)
    settings = RuntimeSettings(threads=(1,), rounds=9, calls=3, json=tmp_path / "r.json")
    report = left_of(evaluate_runtime, settings)
    assert {row["p50_ms"] for row in report["results"]} == {5.0}


def test_nothing_finished_is_no_result(images, interrupted, tmp_path):
    settings = CodecSettings(images=images, codec=("phase",), snr_db=(20.0, 15.0), json=tmp_path / "r.json")
    with pytest.raises(KeyboardInterrupt) as caught:
        evaluate_codec(settings, [interrupted(3)])
    assert caught.type is KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["images"]
    with until_interrupted([]) as part:
        pass
    assert not part.is_cut


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("to_stdout", [False, True])
def test_the_table_of_an_interrupted_run_is_printed(
    number, to_stdout, images, interrupted, tmp_path, capsys, monkeypatch
):
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("this process was told to ignore the signal, and so does an evaluation")
    cls, _, skip, text = EVALUATIONS["codec"]
    codec = interrupted(4, number)
    evaluate = (cls, lambda settings: evaluate_codec(settings, [codec]), skip, text)
    monkeypatch.setitem(EVALUATIONS, "codec", evaluate)
    file = tmp_path / "whole.json"
    file.write_text("of the last run")
    words = ["eval", "codec", "--images", str(images), "--codec", "jpeg-ldpc", "--snr-db", "12", "9"]
    before = [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)]
    assert main([*words, "--json", "-" if to_stdout else str(file)]) == 130
    assert [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)] == before
    said = capsys.readouterr()
    table = said.err if to_stdout else said.out
    assert "Partial: interrupted before all was measured." in table
    assert "phase 12" in " ".join(table.split())
    assert file.read_text() == "of the last run"
    partial = tmp_path / "whole.partial.json"
    assert (f"written: {partial}\n" in said.err) == partial.exists() == (not to_stdout)
    report = json.loads(said.out if to_stdout else partial.read_text())
    assert (report["partial"], len(report["results"])) == (True, 1)
