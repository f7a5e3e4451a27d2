"""The readout time of a rolling shutter is found from its images."""

import json
from pathlib import Path

import numpy as np
import pytest

from semcast.cli import main
from semcast.common.camera import Intrinsics
from semcast.common.errors import SemcastError
from semcast.evaluation import readout
from semcast.evaluation.readout import Readout, ReadoutSettings, Trial, fitted, search
from semcast.evaluation.scenes.render import RenderSettings, render_scene


def lean(true: Readout, bend: float = 0.03, noise_px: float = 0.2):
    """Error of a readout time where rows lean in proportion to how wrong it is."""

    def error_px(tried: Readout) -> float:
        wrong_ms = tried.signed_ms - (true.signed_ms if tried.axis == true.axis else 0.0)
        other_ms = 0.0 if tried.axis == true.axis else true.signed_ms
        return float(np.sqrt(noise_px**2 + bend**2 * (wrong_ms**2 + other_ms**2)))

    return error_px


def trial(tried: Readout, error_px: float, rng: np.random.Generator, count: int = 60) -> Trial:
    return Trial(tried, {k: error_px * rng.uniform(0.9, 1.1) for k in range(count)})


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("true_ms", [-33.0, -4.0, 0.0, 6.0, 19.0, 48.0])
def test_the_search_ends_within_a_step_of_the_least(axis, true_ms):
    tried: list[Readout] = []
    error_px = lean(Readout(axis, true_ms))

    def seen(r: Readout) -> float:
        tried.append(r)
        return error_px(r)

    best = search(seen, 66.7)
    assert abs(best.signed_ms - true_ms) <= 1.25 + 1e-9
    assert best.axis == axis or best.signed_ms == 0
    assert len(set(tried)) <= 18
    assert len({r for r in tried if r.signed_ms == 0}) == 1, "0 ms is the same along both axes"


def test_no_readout_is_longer_than_a_frame():
    assert search(lean(Readout("rows", 48.0)), 33.3).signed_ms == 32.5


@pytest.mark.parametrize("true", [Readout("rows", 19.0), Readout("columns", -3.0), Readout("rows", 0.0)])
def test_the_least_between_the_trials_is_found_with_its_bounds(true, rng):
    error_px, trials = lean(true), {}

    def tried(r: Readout) -> float:
        trials[r] = trial(r, error_px(r), rng)
        return error_px(r)

    best = search(tried, 66.7)
    found, low_ms, high_ms = fitted(best, list(trials.values()))
    assert found.signed_ms == pytest.approx(true.signed_ms, abs=0.6)
    assert low_ms < found.signed_ms < high_ms < low_ms + 2.0


def test_images_that_do_not_tell_are_refused(rng):
    at_ms = (-10.0, -5.0, -2.5, 0.0, 2.5, 5.0, 10.0)
    flat = [trial(Readout("rows", ms), 0.5, rng) for ms in at_ms]
    with pytest.raises(SemcastError, match="these images don't tell the readout time"):
        fitted(Readout("rows", 0.0), flat)
    error_px = lean(Readout("rows", 0.0))
    few = [trial(Readout("rows", ms), error_px(Readout("rows", ms)), rng, count=29) for ms in at_ms]
    with pytest.raises(SemcastError, match="only 29 frames got a pose in every trial, 30 are needed"):
        fitted(Readout("rows", 0.0), few)


@pytest.mark.parametrize("count", [31, 60])
def test_the_bounds_of_few_frames_cover_what_they_say(count, rng):
    at_ms = np.array([5.0, 7.5, 10.0, 12.5, 15.0, 20.0])
    found = []
    for _ in range(300):
        # What frames after each other say is alike.
        own_ms = np.convolve(rng.normal(0.0, 1.0, count + 1), (0.7, 0.7), mode="valid")
        errors_px = np.sqrt(0.3**2 + 0.03**2 * (at_ms[:, None] - 11.0 - own_ms) ** 2)
        errors_px *= rng.uniform(0.97, 1.03, errors_px.shape)
        trials = [
            Trial(Readout("rows", ms), dict(enumerate(e))) for ms, e in zip(at_ms, errors_px, strict=True)
        ]
        readout_, low_ms, high_ms = fitted(Readout("rows", 10.0), trials)
        found.append((readout_.signed_ms, low_ms, high_ms))
    least_ms, low_ms, high_ms = np.array(found).T
    covered = np.mean((low_ms < least_ms.mean()) & (least_ms.mean() < high_ms))
    assert 0.9 < covered < 0.99


def test_a_side_and_a_time_say_what_is_read_first():
    assert str(Readout("rows", 20.0)) == "20.0 ms from top"
    assert str(Readout("rows", -20.0)) == "20.0 ms from bottom"
    assert str(Readout("columns", 3.14)) == "3.1 ms from left"
    assert str(Readout("columns", -3.14)) == "3.1 ms from right"
    with pytest.raises(ValueError, match=r"frames must be in \[31, 1000\], got 30"):
        ReadoutSettings(source="0", frames=30)


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room through a rolling shutter whose calibration does not say so."""
    folder = tmp_path_factory.mktemp("readout") / "room"
    render_scene(RenderSettings(pace="fast", seed=11, seconds=1.4, readout_ms=20.0, out=folder))
    camera = Intrinsics.load(folder / "intrinsics.json").to_dict()
    (folder / "intrinsics.json").write_text(json.dumps({**camera, "readout_ms": 0.0}))
    return folder


def test_the_readout_of_a_drawn_shutter_is_found_and_written(rolling, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(readout, "_MAX_PIXELS", 240 * 180)
    out = tmp_path / "intrinsics.json"
    result = tmp_path / "result.json"
    assert main(["shutter", str(rolling), "--out", str(out), "--json", str(result)]) == 0
    said = capsys.readouterr()
    before, found = Intrinsics.load(rolling / "intrinsics.json"), Intrinsics.load(out)
    assert found.readout_from == "top"
    assert 16.0 < found.readout_ms < 22.0
    assert (found.fx, found.width) == (before.fx, before.width)
    assert f"--readout-ms {found.readout_ms:g} --readout-from top" in said.out
    assert "20.0 ms from top: reprojection error" in said.err
    report = json.loads(result.read_text())
    assert report["command"].startswith("semcast shutter ")
    assert report["readout_ms"] == found.readout_ms
    assert report["interval_ms"][0] < report["least_ms"] < report["interval_ms"][1]
    assert len(report["trials"]) == said.err.count(" px in ")


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
    assert "px in" not in said


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


def test_a_trial_that_lost_the_camera_is_not_the_best(rolling, monkeypatch):
    def tried(frames, camera, at):
        # The easy frames of a lost camera have the least error of all.
        is_lost = at.signed_ms == -10
        error_px = 0.1 if is_lost else 0.3 + 0.02 * abs(at.signed_ms - 10) + (at.axis == "columns")
        count = len(frames) // 3 if is_lost else len(frames)
        return Trial(at, {k: error_px * (1 + 0.1 * (k % 3)) for k in range(count)})

    monkeypatch.setattr(readout, "_tried", tried)
    found = readout.find_readout(ReadoutSettings(source=str(rolling)))
    assert found.camera.readout_ms == pytest.approx(10.0, abs=1.0)
    assert found.camera.readout_from == "top"
