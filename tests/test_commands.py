"""What each verb makes of its arguments, and what it says when it can't."""

import argparse
import json
import os
import re
import signal
import threading
import time
from dataclasses import fields
from pathlib import Path

import pytest
from running_channel import running_channel

from semcast.agent.play import PlaySettings
from semcast.agent.settings import AgentSettings
from semcast.agent.source_settings import SourceSettings
from semcast.channel.emulator import set_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.cli import main, verb_parser
from semcast.commands.agent import settings_of
from semcast.commands.evaluate import EVALUATIONS
from semcast.commands.running import read_given, read_settings, run_until_stopped
from semcast.common.argument_order import arguments_last
from semcast.common.codec import DEFAULT_CODEC
from semcast.common.config import to_toml
from semcast.common.loopback import free_endpoint
from semcast.demo import DemoSettings
from semcast.server.record import RecordSettings
from semcast.server.replay import ReplaySettings
from semcast.server.settings import ServerSettings
from semcast.training.settings import TrainSettings

SETTINGS = {
    ("agent",): AgentSettings,
    ("channel", "run"): EmulatorSettings,
    ("server",): ServerSettings,
    ("demo",): DemoSettings,
    ("record",): RecordSettings,
    ("replay",): ReplaySettings,
    ("play",): PlaySettings,
    ("train",): TrainSettings,
    **{("eval", what): row[0] for what, row in EVALUATIONS.items()},
}


@pytest.fixture
def channel():
    """The endpoint of a running channel."""
    with running_channel() as endpoint:
        yield endpoint


def parser_of(verb, *words):
    parser = verb_parser(verb)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices[words[0]]
    return parser


@pytest.mark.parametrize(
    ("text", "cls", "expected"),
    [
        ("record --connect tcp/a:1 mine.mcap", RecordSettings, {"file": Path("mine.mcap")}),
        ("replay --distortion 0 -0.1 0 0 mine.mcap", ReplaySettings, {"file": Path("mine.mcap")}),
        ("channel --connect tcp/a:1 set --snr-db 3", EmulatorSettings, {"link": {"snr_db": 3.0}}),
    ],
)
def test_file_and_action_may_stand_behind_flags_with_several_values(text, cls, expected):
    verb, *words = text.split()
    parser = verb_parser(verb)
    arguments = parser.parse_args(arguments_last(parser, words))
    assert expected.items() <= read_given(cls, arguments).items()
    assert getattr(arguments, "action", "set") == "set"


def sample(action):
    """A value for an option: words of a command line and a value of TOML."""
    if isinstance(action, argparse.BooleanOptionalAction):
        return [action.option_strings[0]], "true"
    value = next(iter(action.choices)) if action.choices else {int: 3, float: 1.5}.get(action.type, "some")
    text = json.dumps(value)
    return [*action.option_strings, str(value)], f"[{text}]" if action.nargs == "+" else text


@pytest.mark.parametrize("words", SETTINGS, ids=" ".join)
def test_a_settings_file_takes_every_flag_of_the_verb_by_its_name(words, tmp_path):
    line, lines = [], []
    for action in parser_of(*words)._actions:
        if action.dest in ("help", "debug", "config", "action"):
            continue
        given, value = sample(action)
        name = action.option_strings[0].removeprefix("--") if action.option_strings else action.dest
        line += given
        lines.append(f"{name.replace('-', '_')} = {value}\n")
    file = tmp_path / "settings.toml"
    file.write_text("".join(lines))
    verb, cls = verb_parser(words[0]), SETTINGS[words]
    by_flags = read_given(cls, verb.parse_args([*words[1:], *line]))
    assert read_given(cls, verb.parse_args([*words[1:], "--config", str(file)])) == by_flags


@pytest.mark.parametrize("words", SETTINGS, ids=" ".join)
def test_settings_that_a_verb_wrote_down_give_the_same_again(words, tmp_path):
    cls, parser = SETTINGS[words], verb_parser(words[0])
    # Whatever is required: a source, a sequence, images or a recording.
    needed = {
        "source": SourceSettings(source="0"), "sequence": Path("s"), "images": Path("i"), "file": Path("f"),
    }  # fmt: skip
    required = {f.name: needed[f.name] for f in fields(cls) if f.default is f.default_factory}
    settings = cls(**required)
    file = tmp_path / "settings.toml"
    file.write_text(to_toml(settings))
    assert read_settings(cls, parser.parse_args([*words[1:], "--config", str(file)])) == settings


def test_record_writes_run_mcap_unless_told_otherwise(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text('file = "mine.mcap"\n')
    for words, expected in (([], "run.mcap"), (["--config", str(file)], "mine.mcap"), (["x.mcap"], "x.mcap")):
        arguments = verb_parser("record").parse_args(words)
        assert read_settings(RecordSettings, arguments).file == Path(expected)


@pytest.mark.parametrize(
    ("words", "missing"),
    [
        (["agent"], "--source"),
        (["eval", "trajectory"], "--sequence"),
        (["eval", "codec"], "--images"),
        (["eval", "recording"], "FILE"),
        (["replay"], "FILE"),
        (["play"], "FILE"),
    ],
)
def test_a_missing_setting_is_wrong_usage(words, missing, capsys):
    assert main(words) == 2
    assert capsys.readouterr().err == f"semcast {words[0]}: {missing} is required\n"


def test_set_is_checked_against_the_running_channel(channel, tmp_path, capsys):
    words = ["channel", "set", "--agent-id", "a", "--connect", channel]
    assert main([*words, "--channel", "burst", "--slot-loss", "0.9"]) == 0
    now = json.loads(capsys.readouterr().out)
    assert (now["channel"], now["slot_loss"], now["burst_slots"]) == ("burst", 0.9, 20.0)
    assert main([*words, "--burst-slots", "4"]) == 1
    assert "--burst-slots must be at least 9 for a slot_loss of 0.9, got 4" in capsys.readouterr().err
    file = tmp_path / "settings.toml"
    file.write_text("snr_db = 3\nslot_loss = 0.4\n")
    assert main([*words, "--config", str(file), "--slot-loss", "0.5"]) == 0
    now = json.loads(capsys.readouterr().out)
    assert (now["snr_db"], now["slot_loss"], now["burst_slots"]) == (3.0, 0.5, 20.0)
    file.write_text("snr_db = 99\n")
    assert main([*words, "--config", str(file), "--slot-loss", "0.5"]) == 1
    assert f": {file}: snr_db must be in [-5, 30], got 99" in capsys.readouterr().err


def test_what_does_nothing_is_said(channel, capsys, caplog):
    words = ["channel", "set", "--agent-id", "a", "--connect", channel]
    for slot_loss in ("0.3", "0.2"):  # 0.2 is the default, and as idle
        assert main([*words, "--channel", "awgn", "--slot-loss", slot_loss, "--seed", "7"]) == 0
        assert "seed: no effect on a channel that runs" in caplog.text
        told = [r.name for r in caplog.records if "slot_loss: no effect on channel awgn" in r.getMessage()]
        assert len(told) == 2  # by the channel, and where the command was typed
        caplog.clear()
    assert main([*words, "--channel", "erasure"]) == 0
    assert "no effect" not in caplog.text


def test_fading_within_slots_is_said_and_not_refused(channel, capsys, caplog):
    words = ["channel", "set", "--agent-id", "a", "--connect", channel]
    assert main([*words, "--channel", "rayleigh", "--doppler-hz", "30"]) == 0
    line = "doppler_hz times slot_ms should be at most 20, got 30: a real link would fade within slots"
    assert [r.getMessage() for r in caplog.records].count(line) == 2
    caplog.clear()
    assert main([*words, "--snr-db", "7"]) == 0
    assert main([*words, "--doppler-hz", "20"]) == 0
    assert "fade within" not in caplog.text


def test_a_trace_of_this_folder_is_found_by_a_channel_in_another(channel, tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "snr.csv").write_text("t_s,snr_db\n0,4\n1,8\n")
    asked = []

    def from_elsewhere(network, agent_id, changes):
        monkeypatch.chdir(tmp_path)
        asked.append(changes)
        return set_channel(network, agent_id, changes)

    monkeypatch.setattr("semcast.commands.channel.set_channel", from_elsewhere)
    monkeypatch.chdir(tmp_path / "here")
    words = ["--channel", "trace", "--trace", "file", "--trace-file", "snr.csv"]
    assert main(["channel", "set", "--agent-id", "a", "--connect", channel, *words]) == 0
    assert json.loads(capsys.readouterr().out)["trace_file"] == str(tmp_path / "here" / "snr.csv")
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("snr_bd = 3", "unknown setting 'snr_bd', did you mean 'snr_db'"),
        ("snr_db = 'low'", "settings.toml: snr_db must be of type float, got 'low'"),
        ("snr_db = nan", "snr_db must be in [-5, 30], got nan"),
        ("jitter_ms = inf", "jitter_ms must be in [0, 10000], got inf"),
        ("", "set needs a value to change"),
    ],
)
def test_set_refuses_what_no_channel_takes_without_asking_one(tmp_path, capsys, text, message):
    file = tmp_path / "settings.toml"
    file.write_text(text)
    assert main(["channel", "set", "--connect", free_endpoint(), "--config", str(file)]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.weights
def test_weights_decide_on_the_codec_unless_one_is_named(tmp_path):
    def codec(*words):
        return settings_of(verb_parser("agent").parse_args(["--source", "0", *words])).codec

    file = tmp_path / "settings.toml"
    file.write_text('codec = "3dcsc"\n')
    assert codec() == DEFAULT_CODEC
    assert codec("--weights", "cnn") == "cnn"
    assert codec("--weights", "cnn", "--codec", "3dcsc-lite") == "3dcsc-lite"
    assert codec("--weights", "cnn", "--config", str(file)) == "3dcsc"


def test_a_server_without_a_gpu_says_so_at_once(capsys):
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    assert main(["server", "--device", "cuda"]) == 1
    assert "device must be auto or cpu on this machine" in capsys.readouterr().err


def test_a_server_says_at_once_that_it_cannot_compute_in_a_precision(capsys, monkeypatch):
    from semcast.commands import server
    from semcast.common.nets import precision

    monkeypatch.setattr(server, "run_server", lambda *_: pytest.fail("it runs"))
    monkeypatch.setattr(precision, "has_fast_bfloat16", lambda: False)
    assert main(["server", "--precision", "bfloat16", "--device", "cpu"]) == 1
    assert re.search(r"precision must be one of auto, .*float32 for .*'bfloat16'", capsys.readouterr().err)


@pytest.mark.parametrize(
    "words",
    [["info", ""], ["export", "run", "--format", "tum", "--out", ""], ["plot", "run", "--out", ""]],
)
def test_a_path_without_a_name_is_not_the_working_folder(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "must be the name of a file or folder, got ''" in capsys.readouterr().err


def test_a_run_is_not_exported_onto_itself(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    out = tmp_path / "run" / ".." / "run"
    assert main(["export", str(tmp_path / "run"), "--format", "colmap", "--out", str(out)]) == 1
    err = capsys.readouterr().err
    assert "out must be another place than the run itself and its files, got" in err
    assert err.count("\n") == 1


def test_a_recorder_that_met_nobody_says_that_nothing_was_recorded(tmp_path, capsys):
    file = tmp_path / "keep.mcap"
    file.write_bytes(b"an older recording")
    before, tick = signal.getsignal(signal.SIGINT), threading.Event()

    def interrupt():
        end_s = time.monotonic() + 15.0
        while signal.getsignal(signal.SIGINT) is before and time.monotonic() < end_s:
            tick.wait(0.005)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert main(["record", str(file), "--connect", free_endpoint()]) == 130
    thread.join()
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "nothing was recorded" in shown.err
    assert file.read_bytes() == b"an older recording"


def raise_and_wait(number):
    def work(stop):
        signal.raise_signal(number)
        assert stop.wait(5)

    return work


@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 0), ("SIGHUP", 0)])
def test_a_signal_ends_a_run_in_good_order(number, code):
    number = getattr(signal, number)
    inherited = signal.signal(number, signal.default_int_handler)  # under nohup SIGHUP is ignored
    try:
        assert run_until_stopped(raise_and_wait(number)) == code
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, inherited)


@pytest.mark.parametrize("signals", [("SIGINT", "SIGINT"), ("SIGTERM", "SIGINT"), ("SIGTERM", "SIGTERM")])
def test_a_second_signal_ends_a_run_at_once(signals, monkeypatch):
    monkeypatch.setattr("semcast.commands.running._AGAIN_S", 0.0)

    def work(stop):
        for name in signals:
            signal.raise_signal(getattr(signal, name))
        raise AssertionError("it goes on")

    with pytest.raises(KeyboardInterrupt):
        run_until_stopped(work)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_one_request_to_end_may_come_twice(name):
    number, done = getattr(signal, name), []

    def work(stop):
        signal.raise_signal(number)
        signal.raise_signal(number)
        done.append(stop.is_set())

    before = signal.signal(number, signal.SIG_DFL)  # under nohup, a hang-up is ignored
    try:
        assert run_until_stopped(work) == 0
    finally:
        signal.signal(number, before)
    assert done == [True]


def test_a_run_under_nohup_outlives_its_terminal():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    stopped = []

    def work(stop):
        signal.raise_signal(signal.SIGHUP)
        stopped.append(stop.wait(0.1))

    try:
        assert run_until_stopped(work) == 0
    finally:
        signal.signal(signal.SIGHUP, before)
    assert stopped == [False]
