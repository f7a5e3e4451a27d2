import json
import os
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest

from semcast.common.errors import ConfigError, SemcastError
from semcast.common.source_commit import source_commit
from semcast.evaluation.codec import CodecSettings
from semcast.evaluation.interruption import InterruptedMeasurementError, Part
from semcast.evaluation.moving_images import ImagesSettings
from semcast.evaluation.report import (
    check_outputs,
    command_line,
    json_ready,
    machine_kind,
    naming,
    provenance,
    short_names,
    write_result,
)
from semcast.evaluation.trajectory import TrajectorySettings


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True, kw_only=True)
class LinkSettings:
    loss: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Settings:
    sequence: Path
    link: LinkSettings = LinkSettings()
    snr_db: tuple[float, ...] = (10.0,)
    seeds: int = field(default=1, metadata={"flag": "num_seeds"})
    plots: bool = True


def test_a_weights_file_goes_by_as_much_of_its_path_as_tells_it_apart():
    assert short_names(["/a/b/x.safetensors", "vit"]) == ["x.safetensors", "vit"]
    assert short_names(["/a/b/x.safetensors", "/a/c/x.safetensors"]) == ["b/x.safetensors", "c/x.safetensors"]
    assert short_names(["x.safetensors", "/a/x.safetensors"]) == ["x.safetensors", "a/x.safetensors"]


def test_a_result_names_the_codec_that_was_used(phase_codec):
    one, several = TrajectorySettings(sequence=Path(), modulation="analog"), CodecSettings(images=Path())
    assert naming(one, None) is one
    named = naming(one, phase_codec)
    assert (named.codec, named.modulation) == ("phase", "16qam")
    assert naming(several, [phase_codec]).codec == (phase_codec.name,)
    with pytest.raises(ValueError, match=r"different names, got \('phase', 'phase'\)"):
        naming(several, [phase_codec, phase_codec])


def test_json_has_no_nan_no_arrays_and_no_absolute_path():
    value = {
        "a": np.array([1.0, np.nan]),
        "b": np.float32(2),
        "c": float("inf"),
        "d": Path("/some/where/kitti"),
        "e": Path("runs/x"),
        "f": Colour.RED,
        3: (True, None),
    }
    ready = json_ready(value)
    assert ready == {
        "a": [1.0, None],
        "b": 2.0,
        "c": None,
        "d": "kitti",
        "e": str(Path("runs/x")),
        "f": "red",
        "3": [True, None],
    }
    assert type(ready["f"]) is str
    with pytest.raises(TypeError, match="object"):
        json_ready(object())


def test_written_json_reads_back_and_leaves_no_partial_file(tmp_path):
    path = tmp_path / "new" / "result.json"
    assert write_result(path, {"x": np.arange(3)}) == json.loads(path.read_text()) == {"x": [0, 1, 2]}
    assert [p.name for p in path.parent.iterdir()] == ["result.json"]
    assert write_result(None, {"x": np.arange(3)}) == {"x": [0, 1, 2]}


def test_a_whole_result_takes_the_place_of_its_part(tmp_path):
    path, part = tmp_path / "r.json", Part()
    part.is_cut = True
    with pytest.raises(InterruptedMeasurementError):
        write_result(path, {"x": 1}, part)
    assert [p.name for p in tmp_path.iterdir()] == ["r.partial.json"]
    write_result(path, {"x": 2}, Part())
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]


def test_an_unwritable_place_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SemcastError, match="can't be written"):
        write_result(tmp_path / "file" / "result.json", {})


def test_the_command_names_only_what_differs_from_the_defaults():
    settings = Settings(sequence=Path("/data/chair orbit"), snr_db=(2.0, 6.0), seeds=3, plots=False)
    assert (
        command_line("eval pairs", settings)
        == "semcast eval pairs --sequence 'chair orbit' --snr-db 2.0 6.0 --num-seeds 3 --no-plots"
    )
    assert command_line("eval pairs", Settings(sequence=Path("a"))) == "semcast eval pairs --sequence a"
    nested = Settings(sequence=Path("a"), link=LinkSettings(loss=0.2))
    assert command_line("eval pairs", nested) == "semcast eval pairs --sequence a --loss 0.2"


def test_a_result_tells_no_place_of_a_machine_and_no_password():
    codec = CodecSettings(images=Path("/pictures/street"), codec=("vit", "/home/me/own.safetensors"))
    note = provenance("eval codec", codec)
    assert note["settings"]["codec"] == ["vit", "own.safetensors"]
    assert note["command"].startswith("semcast eval codec --images street --codec vit own.safetensors")
    lens = provenance("lens", ImagesSettings(source="rtsp://me:secret@10.0.0.7/stream"))
    assert lens["command"] == "semcast lens rtsp://10.0.0.7/stream"
    assert lens["settings"]["source"] == "rtsp://10.0.0.7/stream"
    assert provenance("lens", ImagesSettings(source="/home/me/walk.mp4"))["settings"]["source"] == "walk.mp4"


def test_provenance_names_kind_of_machine_commit_and_versions():
    note = provenance("eval pairs", Settings(sequence=Path("a")))
    assert "-core " in note["machine"]
    assert note["machine"] == machine_kind()
    assert note["versions"]["numpy"] == np.__version__
    assert set(note["versions"]) >= {"semcast", "python"}
    assert note["commit"] == source_commit()
    json.dumps(note, allow_nan=False)


def test_places_for_results_are_made_or_refused(tmp_path):
    check_outputs(None, None)
    check_outputs(tmp_path / "a" / "result.json", tmp_path / "b" / "c")
    assert list((tmp_path / "a").iterdir()) == list((tmp_path / "b" / "c").iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"json must be a file, .* is a folder"):
        check_outputs(tmp_path / "a", None)
    with pytest.raises(ConfigError, match=r"json can't be written to .*file/result\.json: "):
        check_outputs(tmp_path / "file" / "result.json", None)
    with pytest.raises(ConfigError, match=r"out must be a folder, .*file is a file"):
        check_outputs(None, tmp_path / "file")
    with pytest.raises(ConfigError, match=r"out can't be written to .*file/below/result\.json: "):
        check_outputs(None, tmp_path / "file" / "below")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may look into every folder")
def test_places_below_a_closed_folder_are_refused(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0)
    for places in ((closed / "result.json", None), (None, closed / "below")):
        with pytest.raises(ConfigError, match="can't be written: Permission denied"):
            check_outputs(*places)
