"""The readout time of a rolling shutter is found from its images."""

import json
import re
from pathlib import Path

import pytest
from full_disk import room_for

from semcast.cli import main
from semcast.common.camera import Intrinsics
from semcast.common.errors import SemcastError
from semcast.evaluation import moving_images, readout
from semcast.evaluation.moving_images import CameraEvidence, ImagesSettings
from semcast.evaluation.readout import Trial
from semcast.evaluation.scenes import render
from semcast.evaluation.scenes.render import RenderSettings, render_scene
from semcast.server.mapping.readout import Readout, ReadoutFit

EVIDENCE = CameraEvidence([], 0.3, 60)


def says(true: Readout, share: float = 0.9, sigma_ms: float = 0.2, num_frames: int = 60):
    """A reconstruction that sees a share of what is missing of the readout, and whose error grows with it."""

    def tried(images, at: Readout) -> Trial:
        missing = true.signed_ms - (at.signed_ms if at.axis == true.axis else 0.0)
        fit = ReadoutFit(Readout(true.axis, true.signed_ms - (1.0 - share) * missing), sigma_ms, 0.1, 8.0)
        return Trial(at, CameraEvidence([], 0.3 + 0.01 * abs(missing), num_frames), fit)

    return tried


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("true_ms", [-20.0, -4.0, 0.0, 6.0, 19.0])
def test_what_is_left_of_the_readout_is_added_until_it_is_nothing(rolling, axis, true_ms, monkeypatch):
    monkeypatch.setattr(readout, "_tried", says(Readout(axis, true_ms)))
    seen: list[Trial] = []
    found = readout.find_readout(ImagesSettings(source=str(rolling)), seen.append)
    assert found.trials == tuple(seen)
    assert len(seen) <= 3
    assert found.readout.signed_ms == pytest.approx(true_ms, abs=0.3)
    assert found.low_ms < found.readout.signed_ms < found.high_ms < found.low_ms + 2.0
    assert found.is_global == (true_ms == 0.0)
    if true_ms:
        assert found.camera.readout_from == Readout(axis, true_ms).side


def test_a_result_that_finds_no_room_costs_neither_the_answer_nor_the_camera(
    rolling, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(readout, "_tried", says(Readout("rows", 19.0)))
    out, result = tmp_path / "camera.json", tmp_path / "result.json"
    with room_for(600):  # for the camera, and not for its result
        assert main(["shutter", str(rolling), "--out", str(out), "--json", str(result)]) == 1
    said = capsys.readouterr()
    assert "--readout-ms " in said.out
    assert Intrinsics.load(out).readout_ms == pytest.approx(19.0, abs=0.3)
    assert f"semcast shutter: {result} can't be written: " in said.err


def test_a_readout_that_makes_nothing_better_is_not_believed(rolling, monkeypatch):
    def tried(images, at: Readout) -> Trial:
        fit = ReadoutFit(Readout("rows", 2.0), 0.3, 0.01, 8.0)
        return Trial(at, CameraEvidence([], 0.3 + 0.01 * at.ms, 60), fit)

    monkeypatch.setattr(readout, "_tried", tried)
    found = readout.find_readout(ImagesSettings(source=str(rolling)))
    assert [trial.readout.signed_ms for trial in found.trials] == [0.0, 2.0]
    assert found.is_global
    assert found.low_ms <= -2.0
    assert found.high_ms >= 2.0, "what residuals speak for may be true all the same"


def test_no_readout_is_longer_than_a_frame(rolling, monkeypatch):
    monkeypatch.setattr(readout, "_tried", says(Readout("rows", 48.0)))
    found = readout.find_readout(ImagesSettings(source=str(rolling)))
    assert found.camera.readout_ms == pytest.approx(1e3 / 30, abs=0.1)


def test_images_that_do_not_tell_are_refused(rolling, monkeypatch):
    settings = ImagesSettings(source=str(rolling))
    monkeypatch.setattr(readout, "_tried", says(Readout("rows", 10.0), sigma_ms=3.0))
    with pytest.raises(SemcastError, match="these images don't tell the readout time"):
        readout.find_readout(settings)
    monkeypatch.setattr(readout, "_tried", lambda images, at: Trial(at, EVIDENCE, None))
    with pytest.raises(SemcastError, match="these images don't tell the readout time"):
        readout.find_readout(settings)
    monkeypatch.setattr(readout, "_tried", says(Readout("rows", 10.0), num_frames=29))
    with pytest.raises(SemcastError, match="only 29 of [0-9]+ frames got a pose, 30 are needed: take images"):
        readout.find_readout(settings)


def test_too_few_frames_are_refused_by_settings():
    with pytest.raises(ValueError, match=r"frames must be in \[31, 1000\], got 30"):
        ImagesSettings(source="0", frames=30)


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room through a rolling shutter whose calibration does not say so."""
    folder = tmp_path_factory.mktemp("readout") / "room"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            render, "_SAMPLES", ((0.0, 0.0),)
        )  # without softened edges it is drawn in a fourth of the time
        render_scene(RenderSettings(pace="fast", seed=11, seconds=1.4, readout_ms=20.0, out=folder))
    camera = Intrinsics.load(folder / "intrinsics.json").to_dict()
    (folder / "intrinsics.json").write_text(json.dumps({**camera, "readout_ms": 0.0}))
    return folder


def test_the_readout_of_a_drawn_shutter_is_found_and_written(rolling, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(moving_images, "_MAX_PIXELS", 240 * 180)
    out = tmp_path / "intrinsics.json"
    result = tmp_path / "result.json"
    assert main(["shutter", str(rolling), "--out", str(out), "--json", str(result)]) == 0
    said = capsys.readouterr()
    before, found = Intrinsics.load(rolling / "intrinsics.json"), Intrinsics.load(out)
    assert found.readout_from == "top"
    assert 16.0 < found.readout_ms < 22.0
    assert (found.fx, found.width) == (before.fx, before.width)
    assert f"--readout-ms {found.readout_ms:g} --readout-from top" in said.out
    assert re.search(r" 0\.0 ms from top: 3\d frames with a pose, reprojection error 0\.\d+ px\n", said.err)
    report = json.loads(result.read_text())
    assert report["command"].startswith("semcast shutter ")
    assert report["readout_ms"] == found.readout_ms
    assert report["interval_ms"][0] < report["least_ms"] < report["interval_ms"][1]
    assert len(report["trials"]) == said.err.count("frames with a pose, reprojection error ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "20"], "frames must be in [31, 1000], got 20"),
        (["--out", "camera.yaml"], "out must be a .json file, got camera.yaml"),
        (["--out", "/proc/camera.json"], "can't be written"),
    ],
)
def test_what_can_not_be_done_is_said_before_the_search(rolling, words, message, capsys):
    assert main(["shutter", str(rolling), *words]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert "reprojection error" not in said


def test_too_few_images_are_refused(rolling, tmp_path, capsys):
    (tmp_path / "images").mkdir()
    for image in sorted((rolling / "images").iterdir())[:20]:
        (tmp_path / "images" / image.name).symlink_to(image)
    (tmp_path / "intrinsics.json").symlink_to(rolling / "intrinsics.json")
    assert main(["shutter", str(tmp_path)]) == 1
    assert "must have more than 30 images, got 20" in capsys.readouterr().err


def test_a_camera_faster_than_any_readout_is_refused(rolling, tmp_path, capsys):
    (tmp_path / "images").symlink_to(rolling / "images")
    (tmp_path / "intrinsics.json").symlink_to(rolling / "intrinsics.json")
    assert main(["shutter", str(tmp_path), "--rate-hz", "250"]) == 1
    assert "must have at most 200 images a second, got 250" in capsys.readouterr().err
