import argparse
import dataclasses
import re
import tomllib
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from semcast.common.config import MissingSettingError, build_settings, check_at_least, near_match, to_toml
from semcast.common.config_flags import add_flags, flag_words, given_values, settings_from
from semcast.common.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Radio:
    snr_db: float = field(default=10.0, metadata={"help": "Es/N0 in dB, 20 % is a percent sign"})

    def __post_init__(self):
        if not -5 <= self.snr_db <= 30:
            raise ValueError(f"snr_db must be in [-5, 30], got {self.snr_db}")


@dataclass(frozen=True, kw_only=True)
class Node:
    name: str = "a"
    mode: Literal["live", "replay"] = "live"
    count: int = 1
    loud: bool = False
    out: Path | None = None
    levels: tuple[float, ...] = (1.0, 2.0)
    radio: Radio = Radio()


@dataclass(frozen=True, kw_only=True)
class Lens:
    fx: float | None = None


@dataclass(frozen=True, kw_only=True)
class Camera:
    camera: str = field(metadata={"help": "number of the camera"})
    lens: Lens = Lens()


@dataclass(frozen=True, kw_only=True)
class Antenna:
    band: Literal["low", "high"] = field(default="low", metadata={"flag": "radio_band"})
    gain_db: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Sender:
    file: Path = field(default=Path("run.mcap"), metadata={"positional": True})
    camera: Camera
    antenna: Antenna = Antenna(band="high")
    snr_db: float = field(default=1.0, metadata={"flag": "expect_snr_db"})

    def __post_init__(self):
        if not -5 <= self.snr_db <= 30:
            raise ValueError(f"snr_db must be in [-5, 30], got {self.snr_db}")


@dataclass(frozen=True, kw_only=True)
class Reader:
    file: Path = field(metadata={"positional": True})


def arguments_of(cls, argv):
    parser = argparse.ArgumentParser()
    add_flags(parser, cls)
    return parser.parse_args(argv)


def parse(argv, config=None, cls=Node):
    return settings_from(cls, arguments_of(cls, argv), config)


@pytest.fixture
def toml(tmp_path):
    def write(text):
        path = tmp_path / "settings.toml"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_flags_win_over_the_file_and_the_file_over_defaults(tmp_path, encoding):
    path = tmp_path / "node.toml"
    path.write_text('name = "file"\ncount = 5\n[radio]\nsnr_db = 4\n', encoding)
    node = parse(["--count", "7", "--no-loud", "--levels", "3", "4"], path)
    assert node == Node(name="file", count=7, levels=(3.0, 4.0), radio=Radio(snr_db=4.0))


def test_an_unknown_key_is_an_error_with_a_hint(tmp_path):
    path = tmp_path / "node.toml"
    path.write_text("[radio]\nsnr = 4\n")
    with pytest.raises(ConfigError, match=r"unknown setting 'radio.snr', did you mean 'snr_db'"):
        parse([], path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"radio": {"snr_db": 42}}, r"snr_db must be in \[-5, 30\], got 42"),
        ({"mode": "liv"}, "mode must be one of live, replay, got 'liv', did you mean 'live'"),
        ({"count": 1.5}, "count must be of type int, got 1.5"),
        ({"count": True}, "count must be of type int, got True"),
        ({"levels": 3.0}, "levels must be a list"),
        ({"out": "runs\0"}, r"out must be the name of a file or folder, got 'runs\\x00'"),
        ({"out": ""}, "out must be the name of a file or folder, got ''"),
        ({"radio": {"snr_db": 10**400}}, "radio.snr_db must fit a float"),
    ],
)
def test_a_bad_value_is_named_with_what_was_allowed(values, message):
    with pytest.raises(ConfigError, match=message):
        build_settings(Node, values)


def test_a_folder_without_a_name_is_not_the_working_folder():
    with pytest.raises(ConfigError, match="out must be the name of a file or folder, got ''"):
        parse(["--out", ""])


def test_only_a_close_name_is_proposed():
    names = ["trace_file", "snr_db", "seed"]
    assert near_match("snr", names) == ", did you mean 'snr_db'?"
    assert near_match("resize", names) == ""
    assert near_match("tra", names) == ", did you mean 'trace_file'?", "it begins so"
    assert near_match("seq", [*names, "sequence"]) == ", did you mean 'sequence'?"
    assert near_match("", names) == ""


@pytest.mark.parametrize("text", ["name = ", "count = " + 5000 * "9", "levels = " + 5000 * "["])
def test_a_broken_file_is_one_clear_error(tmp_path, text):
    path = tmp_path / "node.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="node.toml can't be read as settings"):
        parse([], path)


def test_settings_written_as_toml_read_back_the_same(tmp_path):
    node = Node(name='a "quoted" \\ name', out=tmp_path / "x", levels=(0.5,), radio=Radio(snr_db=-1.5))
    assert build_settings(Node, tomllib.loads(to_toml(node))) == node


@pytest.mark.parametrize("name", ['a "b" \\ c', "tab\t, bell\x07, delete\x7f, line\n", "Zürich \N{SNOWMAN}"])
def test_any_name_of_a_file_is_written_as_toml(name):
    assert build_settings(Node, tomllib.loads(to_toml(Node(name="n", out=Path(name))))).out == Path(name)


def test_a_name_that_is_no_text_does_not_keep_settings_from_being_written():
    written = to_toml(Node(name="n", out=Path("Z\udcfcrich.mcap"))).encode()
    assert build_settings(Node, tomllib.loads(written.decode())).out == Path("Z?rich.mcap")


def test_help_lists_every_field(capsys):
    parser = argparse.ArgumentParser()
    add_flags(parser, Node)
    with pytest.raises(SystemExit):
        parser.parse_args(["--help"])
    text = capsys.readouterr().out
    for name in [f.name for f in dataclasses.fields(Node) if f.name != "radio"] + ["snr_db"]:
        assert "--" + name.replace("_", "-") in text
    assert "20 % is" in text


def test_an_argument_that_is_not_given_leaves_default_and_file_alone(toml):
    sender = ["--camera", "0"]
    assert parse(sender, cls=Sender).file == Path("run.mcap")
    assert parse(sender, toml('file = "mine.mcap"'), cls=Sender).file == Path("mine.mcap")
    assert parse([*sender, "given.mcap"], toml('file = "mine.mcap"'), cls=Sender).file == Path("given.mcap")


@pytest.mark.parametrize(
    "text",
    [
        'camera = "2"\nfx = 7.0\nexpect_snr_db = 3\nradio_band = "low"',
        'snr_db = 3\n[camera]\ncamera = "2"\n[camera.lens]\nfx = 7\n[antenna]\nband = "low"',
        'camera = "2"\nfx = 7\nsnr_db = 3\nradio_band = "low"\n[antenna]\ngain_db = 0.0',
        'camera = "2"\nfx = 7\nsnr_db = 3\nexpect_snr_db = 3.0\nradio_band = "low"\n[antenna]\nband = "low"',
    ],
)
def test_a_file_names_settings_by_their_flag_or_in_their_table(toml, text):
    camera = Camera(camera="2", lens=Lens(fx=7.0))
    assert parse([], toml(text), Sender) == Sender(camera=camera, snr_db=3.0, antenna=Antenna(band="low"))


def test_a_setting_the_command_fills_itself_has_no_name_at_the_top_level(toml):
    skip = frozenset({"radio.snr_db"})
    with pytest.raises(ConfigError, match="unknown setting 'snr_db'"):
        settings_from(Node, argparse.Namespace(), toml("snr_db = 4"), skip)


def test_flags_win_over_a_file_that_names_settings_by_their_flag(toml):
    got = parse(["--camera", "3", "--fx", "9"], toml('camera = "2"\nfx = 7.0'), cls=Sender)
    assert got.camera == Camera(camera="3", lens=Lens(fx=9.0))


@pytest.mark.parametrize(
    ("cls", "text", "message"),
    [
        (Node, "snr_db = 4\n[radio]\nsnr_db = 5", "snr_db and radio.snr_db are one setting, got 4 and 5"),
        (Sender, "expect_snr_db = 4\nsnr_db = 5", "expect_snr_db and snr_db are one setting, got 4 and 5"),
        (Node, "snr_db = nan", "snr_db must be in [-5, 30], got nan"),
        (Sender, 'camera = "0"\nexpect_snr_db = 99.0', "expect_snr_db must be in [-5, 30], got 99.0"),
        (Sender, 'camera = "0"\nfx = "far"', ": fx must be of type float, got 'far'"),
        (Node, "snr_bd = 4", "unknown setting 'snr_bd', did you mean 'snr_db'"),
        (Sender, "exepct_snr = 4", "unknown setting 'exepct_snr', did you mean 'expect_snr_db'"),
        (Node, 'radio = "awgn"', "radio must be a table of settings, got 'awgn'"),
        (Node, 'radio = "awgn"\nsnr_db = 4', "radio must be a table of settings, got 'awgn'"),
        (Node, "[snr_db]\nvalue = 4", ": snr_db must be of type float, got {'value': 4}"),
        (Sender, "[camera]\ncamera = '0'\nlens = 3", "camera.lens must be a table of settings, got 3"),
    ],
)
def test_a_file_that_contradicts_itself_or_the_settings_is_one_clear_error(toml, cls, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse([], toml(text), cls)


@pytest.mark.parametrize(
    ("cls", "text", "message"),
    [
        (Node, "snr_bd = 4", "unknown setting 'snr_bd'"),
        (Node, 'snr_db = "4"', "snr_db must be of type float, got '4'"),
        (Node, '[radio]\nsnr_db = "4"', "radio.snr_db must be of type float, got '4'"),
        (Node, "levels = [1, true]", "levels[1] must be of type float, got True"),
        (Node, "snr_db = 99", "snr_db must be in [-5, 30], got 99.0"),
        (Node, "[radio]\nsnr_db = 99", "radio.snr_db must be in [-5, 30], got 99.0"),
        (Sender, 'snr_db = 99\ncamera = "0"', "snr_db must be in [-5, 30], got 99.0"),
        (Sender, 'expect_snr_db = 99\n[camera]\ncamera = "0"', "expect_snr_db must be in [-5, 30]"),
        (Sender, "[camera]\ncamera = 0", "camera.camera must be of type str, got 0"),
        (Sender, "camera = 0", "camera must be of type str, got 0"),
    ],
)
def test_what_is_wrong_in_a_file_is_said_with_its_name_and_the_key_in_it(toml, cls, text, message):
    file = toml(text)
    with pytest.raises(ConfigError) as error:
        parse([], file, cls)
    assert str(error.value).startswith(f"{file}: {message}")


def test_what_is_wrong_in_a_flag_is_said_with_the_flag_whatever_is_in_the_file(toml):
    with pytest.raises(ConfigError, match="^--snr-db must be in"):
        parse(["--snr-db", "99"], toml("snr_db = 4"))
    with pytest.raises(ConfigError, match="^--expect-snr-db must be in"):
        parse(["--expect-snr-db", "99", "--camera", "0"], cls=Sender)
    with pytest.raises(ConfigError, match="^--out must be the name of a file"):
        parse(["--out", ""], toml("snr_db = 4"))
    with pytest.raises(ConfigError, match="^FILE must be the name of a file"):
        parse(["", "--camera", "0"], cls=Sender)


@pytest.mark.parametrize(
    ("cls", "text", "words", "message"),
    [
        (Node, 'radio = "awgn"', ["--snr-db", "4"], "radio must be a table of settings, got 'awgn'"),
        (Sender, "[camera]\nlens = 3", ["--fx", "4"], "camera.lens must be a table of settings, got 3"),
    ],
)
def test_a_flag_of_a_table_that_is_a_plain_value_in_the_file_is_one_clear_error(
    toml, cls, text, words, message
):
    with pytest.raises(ConfigError, match=message):
        parse(words, toml(text), cls)


def test_a_missing_setting_is_named_as_the_command_line_names_it():
    with pytest.raises(MissingSettingError, match="^--camera is required$"):
        parse([], cls=Sender)
    with pytest.raises(MissingSettingError, match="^FILE is required$"):
        parse([], cls=Reader)
    with pytest.raises(MissingSettingError, match="^camera.camera is required$"):
        build_settings(Sender, {"camera": {"lens": {"fx": 2.0}}})


def test_given_values_hold_no_defaults(toml):
    arguments = arguments_of(Sender, ["--fx", "9", "mine.mcap"])
    given = given_values(Sender, arguments, toml('radio_band = "low"\nsnr_db = 5'))
    assert given == {
        "camera": {"lens": {"fx": 9.0}},
        "file": Path("mine.mcap"),
        "antenna": {"band": "low"},
        "snr_db": 5.0,
    }


def test_one_value_of_a_table_keeps_the_defaults_its_owner_gives_the_others(capsys):
    words = ["--camera", "0", "--gain-db", "3"]
    assert parse(words, cls=Sender).antenna == Antenna(band="high", gain_db=3.0)
    with pytest.raises(SystemExit):
        arguments_of(Sender, ["--help"])
    assert "(default high)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (Node(), []),
        (
            Node(mode="replay", loud=True, levels=(3.0, 4.0), out=Path("a b"), radio=Radio(snr_db=-2.0)),
            ["--mode", "replay", "--loud", "--out", "a b", "--levels", "3.0", "4.0", "--snr-db", "-2.0"],
        ),
        # What is no default of its owner is given, though it is one of its class.
        (
            Sender(file=Path("x.mcap"), camera=Camera(camera="0"), antenna=Antenna()),
            ["x.mcap", "--camera", "0", "--radio-band", "low"],
        ),
        (Reader(file=Path("y")), ["y"]),
    ],
)
def test_the_words_of_settings_make_the_same_settings(settings, words):
    assert flag_words(settings) == words
    assert parse(words, cls=type(settings)) == settings


def test_words_may_name_a_default_too():
    assert flag_words(Node(), always=("radio.snr_db", "loud")) == ["--no-loud", "--snr-db", "10.0"]


def test_the_least_value_of_settings_is_checked_where_there_is_one():
    settings = types.SimpleNamespace(seed=0, stride=0, max_frames=None)
    check_at_least(settings, seed=0, max_frames=1)
    with pytest.raises(ValueError, match="stride must be at least 1, got 0"):
        check_at_least(settings, seed=0, stride=1)
