"""What verbs print reaches the terminal as it is."""

from pathlib import Path

import pytest
from rich.table import Table

import semcast
from semcast.cli import main
from semcast.commands.console import plain_console
from semcast.training.loop import Progress, TrainResult


@pytest.mark.parametrize("text", ["photos [indoor]", "walk [/end]", "install 'semcast[edge]'", "a :smile: b"])
def test_brackets_and_colons_are_no_styles(text, capsys):
    plain_console(stderr=True).print(text)
    plain_console().print(text)
    shown = capsys.readouterr()
    assert shown.err == shown.out == f"{text}\n"


def test_what_is_piped_is_not_folded(monkeypatch, capsys):
    line = ("a word " * 60).rstrip()
    monkeypatch.delenv("COLUMNS", raising=False)
    plain_console().print(line)
    assert capsys.readouterr().out == f"{line}\n"
    monkeypatch.setenv("COLUMNS", "100")
    plain_console().print(line)
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


def test_lines_of_a_piped_table_end_where_their_text_does(monkeypatch, capsys):
    monkeypatch.delenv("COLUMNS", raising=False)
    table = Table(show_header=False, box=None)
    table.add_row("short")
    table.add_row("a good deal longer")
    plain_console().print(table)
    assert [line.lstrip() for line in capsys.readouterr().out.splitlines()] == ["short", "a good deal longer"]


def test_verbs_print_through_no_other_console():
    commands = Path(semcast.__file__).parent / "commands"
    others = [
        file.name for file in commands.glob("*.py") if "rich.console" in file.read_text(encoding="utf-8")
    ]
    assert others == ["console.py"]


@pytest.mark.parametrize("words", [["calibrate"], ["train", "--data"]])
def test_a_verb_that_can_not_begin_says_one_line(words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)  # for what it may write before
    assert main([*words, str(tmp_path)]) == 1
    assert len(capfd.readouterr().err.splitlines()) == 1


def test_training_tells_its_step_and_the_time_left_however_many_figures_there_are(monkeypatch, capsys):
    def train(settings, report, should_stop):
        figures = {f"figure_{k}": 1.0 / 3.0 for k in range(9)}
        report(Progress(123456, 60.0, 0.5, figures))
        return TrainResult(123456, 60.0, "weights", {})

    monkeypatch.setattr("semcast.commands.train.train", train)
    assert main(["train"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("step 123456 figure_0 0.3333")
    assert line.rstrip().endswith("-:--:--")
