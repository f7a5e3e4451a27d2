import argparse
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from semcast.common.argument_order import arguments_last
from semcast.common.config_flags import add_flags, settings_from
from semcast.common.errors import ConfigError
from semcast.common.network_settings import NetworkSettings


@dataclass(frozen=True, kw_only=True)
class Player:
    file: Path = field(default=Path("run.mcap"), metadata={"positional": True})
    levels: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    loud: bool = False
    network: NetworkSettings = field(default=NetworkSettings())


def parse(text):
    parser = argparse.ArgumentParser()
    add_flags(parser, Player)
    return settings_from(Player, parser.parse_args(arguments_last(parser, text.split())))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("--levels 0 -0.5 .1 mine.mcap", Player(file=Path("mine.mcap"), levels=(0.0, -0.5, 0.1))),
        ("--levels .2 -1.8e-05 -2E3", Player(levels=(0.2, -1.8e-05, -2000.0))),
        ("--levels -1e-05 mine.mcap", Player(file=Path("mine.mcap"), levels=(-1e-05,))),
        ("--levels 1 mine.mcap --loud", Player(file=Path("mine.mcap"), levels=(1.0,), loud=True)),
        ("mine.mcap --levels 1 2", Player(file=Path("mine.mcap"), levels=(1.0, 2.0))),
        ("--levels 1 -- mine.mcap", Player(file=Path("mine.mcap"), levels=(1.0,))),
        ("--levels 1 -- 2", Player(file=Path("2"), levels=(1.0,))),
        ("--names a b --loud --levels 1", Player(names=("a", "b"), loud=True, levels=(1.0,))),
        (
            "--connect tcp/a:1 tcp/b:2 mine.mcap --names a",
            Player(
                file=Path("mine.mcap"), names=("a",), network=NetworkSettings(connect=("tcp/a:1", "tcp/b:2"))
            ),
        ),
    ],
)
def test_an_argument_may_follow_a_flag_with_several_values(text, expected):
    assert parse(text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("--levels 1 a.mcap b.mcap", "argument --levels: invalid float value: 'a.mcap'"),
        ("--levels one", "argument --levels: invalid float value: 'one'"),
        ("a.mcap --levels 1 b.mcap", "unrecognized arguments: -- b.mcap"),
    ],
)
def test_words_that_are_neither_value_nor_argument_are_named(text, message, capsys):
    with pytest.raises(SystemExit):
        parse(text)
    assert message in capsys.readouterr().err


def test_a_command_without_arguments_names_the_flag_of_a_wrong_value():
    parser = argparse.ArgumentParser()
    add_flags(parser, NetworkSettings)
    words = ["--connect", "tcp/a:1", "mine.mcap"]
    with pytest.raises(ConfigError, match="connect must be an endpoint such as .*, got 'mine.mcap'"):
        settings_from(NetworkSettings, parser.parse_args(arguments_last(parser, words)))
