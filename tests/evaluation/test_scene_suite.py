"""The benchmark on drawn scenes draws what is missing, once, and writes a result for each."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from semcast.evaluation import scene_suite
from semcast.evaluation.scenes import render
from semcast.evaluation.scenes.render import SCENES


def test_suite_has_every_scene_at_two_paces_some_at_night_and_files_of_their_own(tmp_path: Path) -> None:
    runs = list(scene_suite.suite(tmp_path / "scenes", tmp_path / "results", seeds=2))
    names = list(dict.fromkeys(run.render.out.name for run in runs))
    by_day = [f"{scene}_{pace}" for scene in scene_suite.SCENE_SECONDS for pace in ("normal", "fast")]
    first, again = names[: len(by_day) + 2], names[len(by_day) + 2 :]
    assert first == [*by_day, "room_night", "street_night"]
    by_night = {run.render.out.name for run in runs if run.render.brightness < 1}
    assert by_night == {"room_night", "street_night"}
    runs_first, runs_again = ([run for run in runs if run.render.out.name in part] for part in (first, again))
    assert len({run.render.seed for run in runs_first}) == len(scene_suite.SCENE_SECONDS) + 2
    assert {name.replace("_again", "") for name in again} < set(by_day)
    assert {run.settings.snr_db for run in runs_again} == {(2.0,)}
    assert {run.render.seed for run in runs_again}.isdisjoint(run.render.seed for run in runs_first)
    assert set(scene_suite.SCENE_SECONDS) == set(SCENES) - {"lorry"}
    assert len({run.settings.json for run in runs}) == len(runs)
    assert all(run.settings.sequence == run.render.out for run in runs)


def test_over_the_poor_link_alone_confidence_is_shuffled_too(tmp_path: Path) -> None:
    measured: dict[str, list[tuple[tuple[float, ...], tuple[str, ...]]]] = {}
    for run in scene_suite.suite(tmp_path / "scenes", tmp_path / "results", seeds=2):
        links_and_modes = (run.settings.snr_db, run.settings.confidence)
        measured.setdefault(run.render.out.name, []).append(links_and_modes)
    assert measured["room_normal"] == [((2.0, 6.0), ("robust", "off")), ((2.0,), ("shuffled",))]
    assert measured["room_again_fast"] == [((2.0,), ("robust", "off")), ((2.0,), ("shuffled",))]
    assert measured["room_night"] == [((6.0,), ("robust", "off"))]


def test_a_recording_is_drawn_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = scene_suite.suite

    def short(folder: Path, results: Path, seeds: int):  # type: ignore[no-untyped-def]
        for run in whole(folder, results, seeds):
            yield scene_suite.Run(
                replace(run.render, seconds=0.8),
                replace(run.settings, codec="none", confidence=("robust",), resize=0.5),
            )

    monkeypatch.setattr(scene_suite, "suite", short)
    monkeypatch.setattr(render, "_SAMPLES", ((0.0, 0.0),))  # a fourth of the time to draw it
    arguments = ["--folder", str(tmp_path / "s"), "--results", str(tmp_path / "r")]
    arguments += ["--seeds", "1", "--only", "orbit_normal"]
    (tmp_path / "r").mkdir()
    monkeypatch.setattr(sys, "argv", ["scene_suite", *arguments])
    scene_suite.main()
    drawn = tmp_path / "s" / "orbit_normal" / "images" / "000000.png"
    at_first = drawn.stat().st_mtime_ns
    scene_suite.main()
    assert drawn.stat().st_mtime_ns == at_first
    report = json.loads((tmp_path / "r" / "trajectory_rayleigh_orbit_normal.json").read_text())
    assert report["sequence"] == "orbit_normal"
    assert report["num_frames"] == 8
    assert {path.name for path in (tmp_path / "r").iterdir()} == {
        "trajectory_rayleigh_orbit_normal.json",
        "trajectory_rayleigh_orbit_normal_shuffled.json",
    }
