import argparse
import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from semcast.common.config import add_flags, build_settings, settings_from, to_toml
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


def parse(argv, config=None, **fixed):
    parser = argparse.ArgumentParser()
    add_flags(parser, Node)
    return settings_from(Node, parser.parse_args(argv), config, **fixed)


def test_flags_win_over_the_file_and_the_file_over_defaults(tmp_path):
    path = tmp_path / "node.toml"
    path.write_text('name = "file"\ncount = 5\n[radio]\nsnr_db = 4\n')
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
    ],
)
def test_a_bad_value_is_named_with_what_was_allowed(values, message):
    with pytest.raises(ConfigError, match=message):
        build_settings(Node, values)


def test_a_broken_file_is_one_clear_error(tmp_path):
    path = tmp_path / "node.toml"
    path.write_text("name = ")
    with pytest.raises(ConfigError, match="node.toml can't be read as settings"):
        parse([], path)


def test_settings_written_as_toml_read_back_the_same(tmp_path):
    node = Node(name='a "quoted" \\ name', out=tmp_path / "x", levels=(0.5,), radio=Radio(snr_db=-1.5))
    assert build_settings(Node, tomllib.loads(to_toml(node))) == node


def test_help_lists_every_field(capsys):
    parser = argparse.ArgumentParser()
    add_flags(parser, Node)
    with pytest.raises(SystemExit):
        parser.parse_args(["--help"])
    text = capsys.readouterr().out
    for name in [f.name for f in dataclasses.fields(Node) if f.name != "radio"] + ["snr_db"]:
        assert "--" + name.replace("_", "-") in text
    assert "20 % is" in text
