"""What ``semcast eval`` does around a measurement: places are checked, files written are named."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from full_disk import room_for

from semcast.cli import main
from semcast.commands.evaluate import EVALUATIONS

DEMO = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"

#: Inputs that are not there: that they are missing is said by the measurement itself.
INPUTS = {
    "codec": ["--images", "missing"],
    "recording": ["missing.mcap"],
    "runtime": ["--codec", "missing"],
    "server": ["missing.mcap"],
}


@pytest.mark.parametrize("what", EVALUATIONS)
def test_a_result_that_can_not_be_kept_is_said_before_the_measurement(what, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    words = ["eval", what, *INPUTS.get(what, ["--sequence", "missing"])]
    places = {"--json": tmp_path / "file" / "result.json"}
    if any(field == "out" for field in EVALUATIONS[what][0].__dataclass_fields__):
        places["--out"] = tmp_path / "file"
    for flag, place in places.items():
        assert main([*words, flag, str(place)]) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"semcast eval: {flag} "), said
        assert str(place) in said
        assert said.count("\n") == 1


@pytest.fixture
def codec_words(tmp_path):
    """A measurement of the codec that takes a moment."""
    (tmp_path / "images").mkdir()
    grey = np.tile(np.linspace(0, 255, 96, dtype=np.uint8), (64, 1))
    cv2.imwrite(str(tmp_path / "images" / "grey.png"), grey)
    return ["eval", "codec", "--images", str(tmp_path / "images"), "--codec", "jpeg-ldpc", "--snr-db", "12"]


def test_a_folder_gets_the_result_and_all_files_written_are_named(codec_words, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("of somebody else")
    assert main([*codec_words, "--out", str(out)]) == 0
    said = capsys.readouterr()
    names = ["fig7_psnr.png", "fig8_ssim.png", "pictures_12db.png", "result.json"]
    assert [line for line in said.err.splitlines() if line.startswith("written")] == [
        f"written: {out / name}" for name in names
    ]
    assert json.loads((out / "result.json").read_text())["results"][0]["codec"] == "jpeg-ldpc"
    assert "semcast eval codec" in said.out
    assert "jpeg-ldpc" in said.out
    assert "{" not in said.out


def test_the_result_goes_where_json_says_and_files_written_anew_are_named_again(
    codec_words, tmp_path, capsys
):
    out, file = tmp_path / "out", tmp_path / "elsewhere" / "mine.json"
    for _ in range(2):
        assert main([*codec_words, "--out", str(out), "--json", str(file)]) == 0
        said = capsys.readouterr()
        assert f"written: {file}\n" in said.err
        assert f"written: {out / 'fig7_psnr.png'}\n" in said.err
        assert "jpeg-ldpc" in said.out
    assert file.exists()
    assert not (out / "result.json").exists()


def test_stdout_is_all_json_where_a_script_asks_for_it(codec_words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*codec_words, "--json", "-"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["results"][0]["images"][0]["image"] == "grey.png"
    assert "semcast eval codec" in said.err
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_without_a_file_the_table_is_printed_and_it_is_said_that_nothing_else_is_left(codec_words, capsys):
    assert main(codec_words) == 0
    said = capsys.readouterr()
    assert said.err.startswith("only the table will be left of this run: --json FILE keeps all figures\n")
    assert "written" not in said.err
    assert "PSNR dB" in said.out
    assert "{" not in said.out


def test_of_an_input_that_is_missing_nothing_else_is_said(tmp_path, capsys):
    assert main(["eval", "trajectory", "--sequence", str(tmp_path / "none")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "none" in line


def test_of_a_trace_that_can_not_be_read_nothing_else_is_said(codec_words, tmp_path, capsys):
    trace = ["--channel", "trace", "--trace", "file", "--trace-file", str(tmp_path / "none.csv")]
    assert main([*codec_words[:-2], *trace]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "none.csv can't be read as an SNR trace" in line


def test_a_table_whose_file_finds_no_room_in_the_end_is_shown_all_the_same(codec_words, tmp_path, capsys):
    file = tmp_path / "result.json"
    with room_for(10):
        assert main([*codec_words, "--json", str(file)]) == 1
    said = capsys.readouterr()
    assert "jpeg-ldpc" in said.out
    assert said.err.splitlines()[-1].startswith(f"semcast eval: {file} can't be written: ")
    assert "\nwritten: " not in said.err
    assert not file.exists()


@pytest.mark.parametrize(
    ("words", "idle"),
    [
        (["--channel", "rayleigh", "--slot-loss", "0.5"], "slot_loss: no effect on channel rayleigh"),
        (["--channel", "trace", "--trace", "file"], "snr_db: no effect on channel trace"),
        (["--channel", "awgn", "--slot-loss", "0.2"], "slot_loss: no effect on channel awgn"),
        (["--channel", "erasure", "--slot-loss", "0.5"], None),
    ],
)
def test_what_does_nothing_on_the_channel_is_said(words, idle, codec_words, tmp_path, caplog):
    if "file" in words:
        (tmp_path / "trace.csv").write_text("t_s,snr_db\n0,12\n")
        words = [*words, "--trace-file", str(tmp_path / "trace.csv")]
    assert main([*codec_words, *words]) == 0
    said = [record.message for record in caplog.records if "no effect" in record.message]
    assert said == ([] if idle is None else [idle + " as it is set"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], []),
        (
            ["--channel", "rayleigh", "--snr-db", "6"],
            ["channel, snr_db: no effect with codec none, which sends nothing"],
        ),
    ],
)
def test_a_link_has_no_effect_on_images_that_are_not_sent(words, told, caplog):
    clean = ["eval", "trajectory", "--sequence", str(DEMO), "--codec", "none", "--max-frames", "2"]
    assert main([*clean, "--resize", "0.2", *words]) == 0
    assert [record.message for record in caplog.records if "no effect" in record.message] == told
