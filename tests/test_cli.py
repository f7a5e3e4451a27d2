import io
import logging
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast import cli
from semcast.cli import VERBS, main, verb_parser

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "deploy" / "demo" / "kitti_06"


def test_help_lists_every_verb_and_answers_at_once():
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    shown = subprocess.run(
        [sys.executable, "-m", "semcast", "--help"], capture_output=True, text=True, check=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    for verb in VERBS:
        assert f"\n  {verb}" in shown.stdout
    # Of a core's time, whatever else the machine does; 0.5 s is the aim.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.5


@pytest.mark.parametrize(
    ("verb", "given", "threads", "policy"),
    [
        *((verb, {}, "1", "PASSIVE") for verb in ("agent", "server", "replay", "eval", "lens", "shutter")),
        ("agent", {"OPENBLAS_NUM_THREADS": "3", "OMP_WAIT_POLICY": "ACTIVE"}, "3", "ACTIVE"),
        ("info", {}, None, None),
    ],
)
def test_what_deals_with_frames_leaves_the_other_cores_alone_unless_told(
    monkeypatch, capsys, verb, given, threads, policy
):
    names = ("OPENBLAS_NUM_THREADS", "OMP_WAIT_POLICY")
    own = {name: value for name, value in os.environ.items() if name not in names}
    monkeypatch.setattr(os, "environ", own | given)
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    assert [os.environ.get(name) for name in names] == [threads, policy]


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_the_overview_fits_the_terminal(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main([]) == 0
    assert max(len(line) for line in capsys.readouterr().out.splitlines()) <= columns


def test_the_overview_imports_nothing_heavy():
    code = (
        "import sys; from semcast.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'gtsam', 'rerun', 'cv2', 'numpy', 'zenoh'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_option_of_every_verb_is_explained(verb):
    def actions(parser):
        for action in parser._actions:
            if hasattr(action, "choices") and isinstance(action.choices, dict):
                for child in action.choices.values():
                    yield from actions(child)
            else:
                yield action

    unexplained = [
        a.option_strings or a.dest for a in actions(verb_parser(verb)) if not (a.help or "").strip()
    ]
    assert not unexplained


def test_an_unknown_verb_is_wrong_usage_with_a_hint(capsys):
    assert main(["sever"]) == 2
    assert "did you mean 'server'" in capsys.readouterr().err


def test_an_unknown_option_is_wrong_usage(capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["doctor", "--nonsense"])
    assert exit_info.value.code == 2


@pytest.mark.parametrize("verb", ["demo", "eval pairs"])
def test_a_shortened_option_is_refused_with_the_whole_one_as_a_hint(verb, capsys):
    with pytest.raises(SystemExit):
        main([*verb.split(), "--snr", "3"])
    assert capsys.readouterr().err == (
        f"semcast {verb}: unrecognized arguments: --snr 3, did you mean '--snr-db'? "
        f"('semcast {verb} --help' lists the options)\n"
    )


@pytest.mark.parametrize("option", ["--chanel", "--chanel=rayleigh"])
def test_the_value_of_an_option_that_is_none_is_not_taken_for_an_argument_of_the_verb(option, capsys):
    with pytest.raises(SystemExit):
        main(["channel", "--seed", "1", option, "rayleigh"])
    assert capsys.readouterr().err == (
        f"semcast channel: unrecognized arguments: {option} rayleigh, did you mean '--channel'? "
        "('semcast channel --help' lists the options)\n"
    )


def test_an_option_of_another_sub_verb_is_no_hint(capsys):
    with pytest.raises(SystemExit):
        main(["eval", "latency", "--images=x"])
    assert "unrecognized arguments: --images=x ('semcast eval latency --help'" in capsys.readouterr().err


def test_what_a_sub_verb_does_not_know_is_answered_with_its_own_options(capsys):
    with pytest.raises(SystemExit):
        main(["eval", "codec", "--seq=room", "-x"])  # other sub-verbs have a --sequence
    assert capsys.readouterr().err == (
        "semcast eval codec: unrecognized arguments: --seq=room -x, did you mean '--seed'? "
        "('semcast eval codec --help' lists the options)\n"
    )
    with pytest.raises(SystemExit):
        main(["eval", "trajectory", "--seq", "room"])
    assert "semcast eval trajectory: unrecognized arguments: --seq room, did you mean '--sequence'?" in (
        capsys.readouterr().err
    )


def test_a_word_that_is_none_of_a_few_is_answered_with_these(capsys):
    with pytest.raises(SystemExit):
        main(["channel", "st", "--snr-db", "3"])
    assert capsys.readouterr().err == (
        "semcast channel: action must be one of run, set, got st, did you mean 'set'? "
        "('semcast channel --help' lists the options)\n"
    )
    with pytest.raises(SystemExit):
        main(["export", "run", "--format", "colmapp", "--out", "x"])
    told = capsys.readouterr().err
    assert "semcast export: --format must be one of " in told
    assert "got colmapp, did you mean 'colmap'?" in told


@pytest.mark.parametrize("words", [["channel", "--snr-db", "much"], ["eval", "codec", "--snr-db", "much"]])
def test_wrong_usage_is_one_line_that_names_the_help(words, capsys):
    with pytest.raises(SystemExit):
        main(words)
    verb = " ".join(w for w in words[:-2])
    assert capsys.readouterr().err == (
        f"semcast {verb}: argument --snr-db: invalid float value: 'much' "
        f"('semcast {verb} --help' lists the options)\n"
    )


def test_an_error_is_one_line_and_exit_code_1(tmp_path, capsys):
    missing = tmp_path / "none.toml"
    assert main(["channel", "run", "--config", str(missing)]) == 1
    err = capsys.readouterr().err
    assert "none.toml can't be read as settings" in err
    assert "Traceback" not in err


def test_names_that_are_no_text_are_shown(tmp_path):
    if sys.platform == "darwin":
        pytest.skip("file names are text there")
    folder = os.fsencode(tmp_path) + b"/b\xff"
    os.mkdir(folder)
    shutil.copy(DEMO / "images" / "000000.jpg", folder + b"/0.jpg")
    words = [sys.executable, "-m", "semcast", "info", folder]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert "b\\udcff" in done.stdout, done.stderr
    assert done.returncode == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize("words", [["info", str(DEMO)], ["info", "--help"], ["--help"], ["--version"]])
def test_a_full_disk_behind_standard_output_is_told_in_a_line(words, buffered):
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    command = [sys.executable, "-m", "semcast", *words]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert done.returncode == 1
    assert done.stderr == "semcast: standard output can't be written: No space left on device\n"
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, env=environment)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, ""), "who reads no further knows"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize(
    ("words", "code", "out"),
    [
        (["eval", "codec", "--images", str(DEMO / "images"), "--codec", "jpeg-ldpc"], 0, "jpeg-ldpc "),
        (["info", "/no/where"], 1, ""),
        (["wrong"], 2, ""),
    ],
)
def test_a_log_that_finds_no_room_costs_no_result(words, code, out, buffered):
    if code == 0:
        words = [*words, "--max-images", "1", "--snr-db", "10"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    command = [sys.executable, "-m", "semcast", *words]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=full, text=True, env=environment)
    assert done.returncode == code
    assert out in done.stdout
    assert bool(done.stdout) == bool(out), "not even an empty line"


@pytest.mark.parametrize(("words", "code"), [("info /no/where", 1), ("wrong", 2)])
def test_what_a_closed_standard_error_would_be_told_is_not_among_the_results(words, code):
    command = f"exec {sys.executable} -m semcast {words} 2>&-"
    done = subprocess.run(["sh", "-c", command], stdout=subprocess.PIPE, text=True)
    assert (done.returncode, done.stdout) == (code, "")


@pytest.mark.parametrize(
    "words",
    ["channel --help --typo", "channel --typo x -h", "channel wrong --help", "eval codec --typo --help"],
)
def test_who_asks_for_help_gets_it_beside_a_mistake(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words.split())
    assert stopped.value.code == 0
    said = capsys.readouterr()
    assert said.out.startswith("usage: semcast ")
    assert not said.err


def test_help_is_a_verb_too(capsys):
    for words, first in ((["help"], "usage: semcast VERB"), (["help", "replay"], "usage: semcast replay")):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
        assert capsys.readouterr().out.startswith(first)
    assert main(["help", "rpelay"]) == 2
    assert "did you mean 'replay'" in capsys.readouterr().err


@pytest.mark.parametrize(("is_terminal", "time"), [(True, r"..:..:.."), (False, r"\d{4}-..-..T..:..:..")])
def test_a_log_that_is_kept_tells_the_day(monkeypatch, is_terminal, time):
    log = io.StringIO()
    monkeypatch.setattr(log, "isatty", lambda: is_terminal)
    monkeypatch.setattr(sys, "stderr", log)
    handler = cli._configure_logging(debug=False)
    logging.getLogger("semcast.x").warning("lost")
    logging.getLogger("semcast").removeHandler(handler)
    assert re.fullmatch(time + r" WARNING semcast\.x: lost\n", log.getvalue())


def test_a_missing_file_is_named_once(tmp_path, capsys):
    file = tmp_path / "nope.mcap"
    assert main(["replay", str(file)]) == 1
    assert capsys.readouterr().err == f"semcast replay: {file} can't be read: No such file or directory\n"
    folder = tmp_path / "photos"
    assert main(["train", "--data", str(folder), "--out", str(tmp_path)]) == 1
    why = f"--data must be a folder of images: {folder} can't be read: No such file or directory\n"
    assert capsys.readouterr().err == f"semcast train: {why}"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("channel --channel trace --trace file", "--trace-file must be given for trace 'file', got None"),
        ("agent --source . --pace rate", "--rate-hz must be given for pace 'rate', got None"),
        ("agent --source . --pace receiver", "--pace 'receiver' needs --mode 'replay', got mode 'live'"),
        ("server --marker-id 3", "--marker-id needs --marker-m, got 3 without"),
        (
            f"eval latency --sequence {DEMO} --codec jpeg-amc --max-frames 2",
            "--warmup must leave frames to time, got 5 of 2",
        ),
    ],
)
def test_what_was_not_given_or_is_wrong_with_the_input_is_named_by_its_option(words, message, capsys):
    assert main(words.split()) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"semcast {words.split()[0]}: {message}")


def test_a_settings_file_may_hold_what_is_wrong_so_its_names_are_used(tmp_path, capsys):
    file = tmp_path / "settings.toml"
    file.write_text('channel = "trace"\ntrace = "file"\n')
    assert main(["channel", "--config", str(file)]) == 1
    assert ": trace_file must be given for trace 'file', got None\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "package", "extra"),
    [
        (["onnx", "3dcsc-lite"], "onnx", "train"),
        (["train"], "torch", "train"),
        (["replay", "some.mcap"], "gtsam", "server"),
    ],
)
def test_a_missing_package_is_named_with_the_extra_that_has_it(words, package, extra, monkeypatch, capsys):
    def import_module(name):
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)

    monkeypatch.setattr("importlib.import_module", import_module)
    assert main(words) == 1
    assert f"the package '{package}' is not installed; " in (err := capsys.readouterr().err)
    assert err.endswith(f"needs, in its checkout: pip install '.[{extra}]'\n")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert any(requirement.startswith(package + ">") for requirement in extras[extra])


def test_a_damaged_image_is_told_by_us_and_by_opencv_only_on_request(tmp_path):
    (tmp_path / "images").mkdir()
    whole = cv2.imencode(".png", np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3))[1].tobytes()
    for name, content in (("0.png", whole), ("1.png", whole[: len(whole) // 2])):
        (tmp_path / "images" / name).write_bytes(content)
    words = [sys.executable, "-m", "semcast", "info", str(tmp_path)]
    own = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV_")}
    for env, debug, is_told in (
        (own, [], False),
        (own, ["--debug"], True),
        ({**own, "OPENCV_LOG_LEVEL": "INFO"}, [], True),
    ):
        shown = subprocess.run([*words, *debug], capture_output=True, text=True, check=True, env=env)
        assert "1 of these images" in shown.stdout
        assert ("[ WARN:" in shown.stderr) == is_told


def test_a_home_that_cant_be_written_is_nothing_to_talk_about(tmp_path):
    (tmp_path / "file").touch()
    script = "import semcast.cli as c; c._quieten_libraries(); import matplotlib as m; m.get_configdir()"
    environment = {**os.environ, "MPLCONFIGDIR": str(tmp_path / "file" / "home")}
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert (shown.returncode, shown.stderr) == (0, "")


def test_ctrl_c_while_a_verb_is_imported_waits_until_it_is(monkeypatch, capsys):
    done = []

    def import_module(name):
        signal.raise_signal(signal.SIGINT)
        done.append(name)  # gtsam would fail here with another error

    monkeypatch.setattr("importlib.import_module", import_module)
    assert main(["server"]) == 130
    assert done == ["semcast.commands.server"]
    assert capsys.readouterr().err == ""


def test_ctrl_c_is_no_traceback_before_the_verb_is_known_either(monkeypatch):
    monkeypatch.setattr("semcast.cli._overview", lambda: signal.raise_signal(signal.SIGINT))
    assert main(["server"]) == 130


def test_ctrl_c_while_the_command_line_itself_is_imported_is_no_traceback(tmp_path):
    """Its import takes longer than Python's own start; ``semcast`` and ``python -m semcast`` begin alike."""
    script = tmp_path / "start.py"
    script.write_text(
        "import importlib.abc, runpy, signal, sys\n"
        "class Finder(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name == 'semcast.common.config':\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "runpy.run_module('semcast', run_name='__main__')\n"
    )
    shown = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert (shown.returncode, shown.stderr) == (130, "")


@pytest.mark.parametrize("names_the_path", [True, False])
def test_a_folder_that_may_not_be_looked_into_is_an_error_in_a_line(
    tmp_path, monkeypatch, capsys, names_the_path
):
    def may_not(path):
        raise PermissionError(13, "Permission denied", *([str(path)] if names_the_path else []))

    monkeypatch.setattr(Path, "is_file", may_not)
    assert main(["export", str(tmp_path), "--format", "tum", "--out", str(tmp_path / "x")]) == 1
    err = capsys.readouterr().err
    assert err.startswith("semcast export: Permission denied")
    assert (str(tmp_path) in err) == names_the_path
    assert "None" not in err
    assert err.count("\n") == 1
