"""Focal length and distortion are found from images of a moving camera."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.cli import main
from semcast.common.camera import Intrinsics
from semcast.common.errors import SemcastError
from semcast.evaluation import lens, moving_images
from semcast.evaluation.lens import Lens, LensTrial
from semcast.evaluation.moving_images import Heard, ImagesSettings
from semcast.evaluation.scenes.render import RenderSettings, render_scene
from semcast.server.mapping.lens import LensFit


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lens") / "room"
    render_scene(RenderSettings(pace="fast", seed=11, seconds=1.4, out=folder))
    return folder


def settings_of(room: Path) -> ImagesSettings:
    return ImagesSettings(source=str(room))


def world_of(
    focal: float, radial: float = 0.0, share: float = 0.9, sigma: float = 0.001, num_frames: int = 60
):
    """Reconstructions whose error grows with how wrong the lens is, and which see a share of that."""

    def tried(images, at: Lens, readout) -> LensTrial:
        off = focal / at.focal - 1.0
        bent = radial * (at.focal / focal) ** 2 - at.radial  # in the units of the lens believed in
        heard = Heard([], 0.2 + abs(off) + abs(bent), num_frames)
        is_seen = at.radial or abs(bent) > 0.005
        told = (share * bent, 0.001) if is_seen else (0.0, 0.0)
        return LensTrial(at, heard, LensFit(share * off, told[0], sigma, told[1], 0.1))

    return tried


@pytest.mark.parametrize(("focal", "radial"), [(1.0, 0.0), (1.12, 0.0), (0.9, -0.05), (1.2, 0.3)])
def test_steps_lead_to_the_lens(room, focal, radial, monkeypatch):
    monkeypatch.setattr(lens, "_tried", world_of(focal, radial))
    seen: list[LensTrial] = []
    found = lens.find_lens(settings_of(room), seen.append)
    assert found.trials == tuple(seen)
    before = Intrinsics.load(room / "intrinsics.json")
    assert found.camera.fx == pytest.approx(focal * before.fx, rel=0.003)
    assert found.camera.fy / found.camera.fx == pytest.approx(before.fy / before.fx)
    assert (found.camera.cx, found.camera.cy) == (before.cx, before.cy)
    k1 = found.camera.distortion[0] if found.camera.distortion else 0.0
    assert k1 == pytest.approx(radial, abs=0.006)
    assert found.radial_reach == (pytest.approx(0.0023, abs=0.0002) if radial else None)


def test_from_far_away_it_begins_again_nearer(room, monkeypatch):
    near = world_of(1.25)

    def tried(images, at: Lens, readout) -> LensTrial:
        if at.focal >= 1.15:
            return near(images, at, readout)
        # Lost in a valley of its own.
        return LensTrial(at, Heard([], 0.6 - 0.1 * at.focal, 60), LensFit(-0.05, 0.0, 0.001, 0.0, 0.1))

    monkeypatch.setattr(lens, "_tried", tried)
    found = lens.find_lens(settings_of(room))
    assert [round(trial.lens.focal, 2) for trial in found.trials[:5]] == [1.0, 0.95, 0.97, 0.83, 1.2]
    assert found.camera.fx == pytest.approx(1.25 * Intrinsics.load(room / "intrinsics.json").fx, rel=0.003)


def test_half_a_step_is_tried_where_a_whole_one_leads_too_far(room, monkeypatch):
    near = world_of(1.08, -0.2)

    def tried(images, at: Lens, readout) -> LensTrial:
        trial = near(images, at, readout)
        if at == Lens(1.0, 0.0):
            return replace(trial, change=LensFit(0.12, -0.4, 0.001, 0.001, 0.1))
        return trial

    monkeypatch.setattr(lens, "_tried", tried)
    found = lens.find_lens(settings_of(room))
    assert [round(trial.lens.focal, 2) for trial in found.trials[:3]] == [1.0, 1.12, 1.06]
    assert found.trials[2].lens.radial == pytest.approx(-0.2 * 1.06**2)
    assert found.camera.fx == pytest.approx(1.08 * Intrinsics.load(room / "intrinsics.json").fx, rel=0.003)
    assert found.camera.distortion[0] == pytest.approx(-0.2, abs=0.006)


def test_images_that_do_not_tell_are_refused(room, monkeypatch):
    monkeypatch.setattr(lens, "_tried", world_of(1.0, sigma=0.03))
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(room))

    def contradicts(images, at: Lens, readout) -> LensTrial:
        error_px = 0.2 + abs(at.focal - 1.0)
        return LensTrial(at, Heard([], error_px, 60), LensFit(0.05, 0.0, 0.001, 0.0, 0.1))

    monkeypatch.setattr(lens, "_tried", contradicts)
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(room))
    monkeypatch.setattr(lens, "_tried", lambda images, at, _: LensTrial(at, Heard([], 0.2, 60), None))
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(room))
    monkeypatch.setattr(lens, "_tried", world_of(1.0, num_frames=29))
    with pytest.raises(SemcastError, match="only 29 frames got a pose, 30 are needed"):
        lens.find_lens(settings_of(room))


def test_a_last_step_that_makes_it_worse_widens_the_bounds(room, monkeypatch):
    def tried(images, at: Lens, readout) -> LensTrial:
        error_px = 0.2 + abs(at.focal - 1.1)
        return LensTrial(at, Heard([], error_px, 60), LensFit(0.08, 0.0, 0.001, 0.0, 0.1))

    monkeypatch.setattr(lens, "_tried", tried)
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(room))  # by 8 % is no answer
    monkeypatch.setattr(lens, "_MAX_REACH", 0.1)
    found = lens.find_lens(settings_of(room))
    assert found.focal_reach == 0.08
    assert found.radial_reach is None
    assert [trial.lens.focal for trial in found.trials] == pytest.approx([1.0, 1.08, 1.08**2, 1.08 * 1.04])


def test_a_small_change_may_make_it_a_little_worse_by_chance(room, monkeypatch):
    def world(growth):
        def tried(images, at: Lens, readout) -> LensTrial:
            steps = round((at.focal - 1.0) / 0.008)
            change = LensFit(0.008 if steps < 3 else 0.0, 0.0, 0.004, 0.0, 0.1)
            return LensTrial(at, Heard([], 0.2 * growth**steps, 60), change)

        return tried

    fx = Intrinsics.load(room / "intrinsics.json").fx
    monkeypatch.setattr(lens, "_tried", world(1.01))
    assert lens.find_lens(settings_of(room)).camera.fx == pytest.approx(1.008**3 * fx, rel=1e-4)
    monkeypatch.setattr(lens, "_tried", world(1.03))
    found = lens.find_lens(settings_of(room))
    assert found.camera.fx == fx
    assert 0.008 <= found.focal_reach < 0.011


def test_a_lens_changes_what_is_known_of_a_camera():
    camera = Intrinsics(fx=500.0, fy=510.0, cx=320.0, cy=240.0, width=640, height=480)
    assert Lens(1.1, 0.0).put_on(camera).distortion == ()
    changed = Lens(1.1, -0.05).put_on(camera)
    assert (changed.fx, changed.fy) == pytest.approx((550.0, 561.0))
    assert changed.distortion == (-0.05, 0.0, 0.0, 0.0)
    bent = Intrinsics(**{**vars(camera), "distortion": (0.1, 0.2, 0.001, 0.002, 0.3)})
    assert Lens(1.0, -0.05).put_on(bent).distortion == pytest.approx((0.05, 0.2, 0.001, 0.002, 0.3))


def bend(folder: Path, k1: float) -> None:
    """Draw the images of a folder as a lens would that is not in its calibration."""
    camera = Intrinsics.load(folder / "intrinsics.json")
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(float)
    straight = cv2.undistortPoints(grid.reshape(-1, 1, 2), K, np.array([k1, 0.0, 0.0, 0.0]), P=K)
    sources = straight.reshape(grid.shape).astype(np.float32)
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path))
        cv2.imwrite(
            str(path), cv2.remap(image, sources, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        )


def test_the_lens_of_a_drawn_room_is_found_and_written(room, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(moving_images, "_MAX_PIXELS", 320 * 240)
    bent = shutil.copytree(room, tmp_path / "bent")
    bend(bent, -0.2)
    true = Intrinsics.load(room / "intrinsics.json")
    out, result = tmp_path / "intrinsics.json", tmp_path / "result.json"
    guess = ["--fx", f"{0.92 * true.fx}", "--fy", f"{0.92 * true.fy}", "--cx", "319.5", "--cy", "239.5"]
    assert main(["lens", str(bent), *guess, "--out", str(out), "--json", str(result)]) == 0
    said, found = capsys.readouterr(), Intrinsics.load(out)
    assert found.fx == pytest.approx(true.fx, rel=0.01)
    assert found.distortion[0] == pytest.approx(-0.2, abs=0.01)
    assert found.shape_hw == true.shape_hw
    assert f"focal length: {found.fx:.1f} px (" in said.out
    assert f"radial distortion: k1 {found.distortion[0]:.4f} (+- 0.0" in said.out
    assert f"--fx {found.fx:.2f} --fy " in said.out
    assert "focal length x 1.0000: " in said.err
    assert logging.getLogger("semcast.server").level == logging.NOTSET, "others are heard again"
    report = json.loads(result.read_text())
    assert report["command"].startswith("semcast lens ")
    assert report["found"]["fx"] == found.fx
    assert 0.0 < report["radial_reach"] < 0.02
    assert len(report["trials"]) == said.err.count(" frames with a pose")


def test_a_file_that_can_not_be_written_is_told_before_the_work(room, capsys):
    assert main(["lens", str(room), "--out", "camera.yaml"]) == 1
    assert "out must be a .json file, got camera.yaml" in capsys.readouterr().err
