"""Focal length and distortion are found from images of a moving camera."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from full_disk import room_for

from semcast.cli import main
from semcast.common.camera import Intrinsics
from semcast.common.errors import SemcastError
from semcast.evaluation import lens, moving_images
from semcast.evaluation.lens import Lens, LensTrial
from semcast.evaluation.moving_images import CameraEvidence, ImagesSettings
from semcast.evaluation.scenes import render
from semcast.evaluation.scenes.render import RenderSettings, render_scene
from semcast.server.mapping.lens import LensFit


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of nothing, and what they are said to be taken with."""
    folder = tmp_path_factory.mktemp("lens") / "images"
    (folder / "images").mkdir(parents=True)
    for k in range(31):
        cv2.imwrite(str(folder / "images" / f"{k:02d}.png"), np.full((24, 32, 3), k, np.uint8))
    (folder / "times.txt").write_text("".join(f"{k / 30:.6f}\n" for k in range(31)))
    Intrinsics(fx=26.5, fy=26.5, cx=15.5, cy=11.5, width=32, height=24).save(folder / "intrinsics.json")
    return folder


def settings_of(folder: Path) -> ImagesSettings:
    return ImagesSettings(source=str(folder))


def world_of(
    focal: float, radial: float = 0.0, share: float = 0.9, sigma: float = 0.001, num_frames: int = 60
):
    """Reconstructions whose error grows with how wrong the lens is, and which see a share of that."""

    def tried(images, at: Lens, readout) -> LensTrial:
        off = focal / at.focal - 1.0
        bent = radial * (at.focal / focal) ** 2 - at.radial[0]  # in the units of the lens believed in
        evidence = CameraEvidence([], 0.2 + abs(off) + abs(bent), num_frames)
        is_seen = at.num_radial or abs(bent) > 0.005
        told = (share * bent, 0.001) if is_seen else (0.0, 0.0)
        return LensTrial(
            at, evidence, LensFit(share * off, (told[0], 0.0), sigma_focal=sigma, sigma_radial=(told[1], 0.0))
        )

    return tried


@pytest.mark.parametrize(("focal", "radial"), [(1.0, 0.0), (1.12, 0.0), (0.9, -0.05), (1.2, 0.3)])
def test_steps_lead_to_the_lens(images, focal, radial, monkeypatch):
    monkeypatch.setattr(lens, "_tried", world_of(focal, radial))
    seen: list[LensTrial] = []
    found = lens.find_lens(settings_of(images), seen.append)
    assert found.trials == tuple(seen)
    before = Intrinsics.load(images / "intrinsics.json")
    assert found.camera.fx == pytest.approx(focal * before.fx, rel=0.003)
    assert found.camera.fy / found.camera.fx == pytest.approx(before.fy / before.fx)
    assert (found.camera.cx, found.camera.cy) == (before.cx, before.cy)
    k1 = found.camera.distortion[0] if found.camera.distortion else 0.0
    assert k1 == pytest.approx(radial, abs=0.006)
    assert found.radial_reach == ((pytest.approx(0.0023, abs=0.0002),) if radial else ())


def test_from_far_away_it_begins_again_nearer(images, monkeypatch):
    near = world_of(1.25)

    def tried(images, at: Lens, readout) -> LensTrial:
        if at.focal >= 1.15:
            return near(images, at, readout)
        # Lost in a valley of its own.
        return LensTrial(
            at, CameraEvidence([], 0.6 - 0.1 * at.focal, 60), LensFit(-0.05, (0.0, 0.0), sigma_focal=0.001)
        )

    monkeypatch.setattr(lens, "_tried", tried)
    found = lens.find_lens(settings_of(images))
    assert [round(trial.lens.focal, 2) for trial in found.trials[:5]] == [1.0, 0.95, 0.97, 0.83, 1.2]
    assert found.camera.fx == pytest.approx(1.25 * Intrinsics.load(images / "intrinsics.json").fx, rel=0.003)


def test_half_a_step_is_tried_where_a_whole_one_leads_too_far(images, monkeypatch):
    near = world_of(1.08, -0.2)

    def tried(images, at: Lens, readout) -> LensTrial:
        trial = near(images, at, readout)
        if at == Lens():
            return replace(
                trial, change=LensFit(0.12, (-0.4, 0.0), sigma_focal=0.001, sigma_radial=(0.001, 0.0))
            )
        return trial

    monkeypatch.setattr(lens, "_tried", tried)
    found = lens.find_lens(settings_of(images))
    assert [round(trial.lens.focal, 2) for trial in found.trials[:3]] == [1.0, 1.12, 1.06]
    assert found.trials[2].lens.radial == pytest.approx((-0.2 * 1.06**2, 0.0))
    assert found.camera.fx == pytest.approx(1.08 * Intrinsics.load(images / "intrinsics.json").fx, rel=0.003)
    assert found.camera.distortion[0] == pytest.approx(-0.2, abs=0.006)


def test_images_that_do_not_tell_are_refused(images, monkeypatch):
    monkeypatch.setattr(lens, "_tried", world_of(1.0, sigma=0.03))
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(images))

    def contradicts(images, at: Lens, readout) -> LensTrial:
        error_px = 0.2 + abs(at.focal - 1.0)
        return LensTrial(at, CameraEvidence([], error_px, 60), LensFit(0.05, (0.0, 0.0), sigma_focal=0.001))

    monkeypatch.setattr(lens, "_tried", contradicts)
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(images))
    monkeypatch.setattr(
        lens, "_tried", lambda _, at, readout: LensTrial(at, CameraEvidence([], 0.2, 60), None)
    )
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(images))
    monkeypatch.setattr(lens, "_tried", world_of(1.0, num_frames=29))
    with pytest.raises(SemcastError, match="only 29 of 31 frames got a pose, 30 are needed: take images"):
        lens.find_lens(settings_of(images))
    with pytest.raises(SemcastError, match=r"30 are needed: allow for more \(--frames\), or take images"):
        lens.find_lens(ImagesSettings(source=str(images), frames=31))


def test_a_last_step_that_makes_it_worse_widens_the_bounds(images, monkeypatch):
    def tried(images, at: Lens, readout) -> LensTrial:
        error_px = 0.2 + abs(at.focal - 1.1)
        return LensTrial(at, CameraEvidence([], error_px, 60), LensFit(0.08, (0.0, 0.0), sigma_focal=0.001))

    monkeypatch.setattr(lens, "_tried", tried)
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        lens.find_lens(settings_of(images))  # by 8 % is no answer
    monkeypatch.setattr(lens, "_MAX_REACH", 0.1)
    found = lens.find_lens(settings_of(images))
    assert found.focal_reach == 0.08
    assert found.radial_reach == ()
    assert [trial.lens.focal for trial in found.trials] == pytest.approx([1.0, 1.08, 1.08**2, 1.08 * 1.04])


def test_what_the_last_step_still_asks_for_is_within_the_bounds(images, monkeypatch):
    def tried(images, at: Lens, readout) -> LensTrial:
        return LensTrial(at, CameraEvidence([], 0.2, 60), LensFit(0.02, (0.03, 0.0), sigma_focal=0.001))

    monkeypatch.setattr(lens, "_tried", tried)
    found = lens.find_lens(settings_of(images))
    assert len(found.trials) == 1 + lens._MAX_STEPS
    assert found.focal_reach == 0.02
    assert found.radial_reach == (0.03,)


def test_a_small_change_may_make_it_a_little_worse_by_chance(images, monkeypatch):
    def world(growth):
        def tried(images, at: Lens, readout) -> LensTrial:
            steps = round((at.focal - 1.0) / 0.008)
            change = LensFit(0.008 if steps < 3 else 0.0, (0.0, 0.0), sigma_focal=0.004)
            return LensTrial(at, CameraEvidence([], 0.2 * growth**steps, 60), change)

        return tried

    fx = Intrinsics.load(images / "intrinsics.json").fx
    monkeypatch.setattr(lens, "_tried", world(1.01))
    assert lens.find_lens(settings_of(images)).camera.fx == pytest.approx(1.008**3 * fx, rel=1e-4)
    monkeypatch.setattr(lens, "_tried", world(1.03))
    found = lens.find_lens(settings_of(images))
    assert found.camera.fx == fx
    assert 0.008 <= found.focal_reach < 0.011


def test_a_lens_changes_what_is_known_of_a_camera():
    camera = Intrinsics(fx=500.0, fy=510.0, cx=320.0, cy=240.0, width=640, height=480)
    assert Lens(1.1, (0.0, 0.0)).put_on(camera).distortion == ()
    changed = Lens(1.1, (-0.05, 0.0)).put_on(camera)
    assert (changed.fx, changed.fy) == pytest.approx((550.0, 561.0))
    assert changed.distortion == (-0.05, 0.0, 0.0, 0.0)
    bent = Intrinsics(**{**vars(camera), "distortion": (0.1, 0.2, 0.001, 0.002, 0.3)})
    moved = Lens(1.1, centre=(0.02, -0.01)).put_on(camera)
    assert (moved.cx, moved.cy) == pytest.approx((330.0, 234.9))
    longer = Lens(2.0).put_on(bent).distortion
    assert longer == pytest.approx((0.4, 3.2, 0.002, 0.004, 19.2))
    assert Lens(1.0, (-0.05, 0.0)).put_on(bent).distortion == pytest.approx((0.05, 0.2, 0.001, 0.002, 0.3))


@pytest.mark.slow
def test_the_lens_of_a_drawn_room_is_found_and_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(moving_images, "_MAX_PIXELS", 320 * 240)
    monkeypatch.setattr(render, "_SAMPLES", ((0.0, 0.0),))  # a fourth of the time to draw it
    monkeypatch.setattr(lens, "_NOTHING", 0.005)  # five reconstructions, where eight end nearer by a hair
    bent, lens_drawn = tmp_path / "bent", (-0.28, 0.07, 0.0, 0.0)
    render_scene(RenderSettings(pace="fast", seed=11, seconds=1.4, distortion=lens_drawn, out=bent))
    true = Intrinsics.load(bent / "intrinsics.json")
    out, result = tmp_path / "intrinsics.json", tmp_path / "result.json"
    guess = ["--fx", f"{0.96 * true.fx}", "--fy", f"{0.96 * true.fy}", "--cx", "319.5", "--cy", "239.5"]
    assert main(["lens", str(bent), *guess, "--out", str(out), "--json", str(result)]) == 0
    said, found = capsys.readouterr(), Intrinsics.load(out)
    assert found.fx == pytest.approx(true.fx, rel=0.015)
    assert found.distortion[:2] == pytest.approx((-0.28, 0.07), abs=0.015)
    assert found.shape_hw == true.shape_hw
    assert f"focal length: {found.fx:.1f} px (" in said.out
    assert f"radial distortion: k1 {found.distortion[0]:.4f} (+- 0.0" in said.out
    assert f"--fx {found.fx:.2f} --fy " in said.out
    assert "focal length x 1.0000: " in said.err
    assert logging.getLogger("semcast.server").level == logging.NOTSET, "others are heard again"
    report = json.loads(result.read_text())
    assert report["command"].startswith("semcast lens ")
    assert report["found"]["fx"] == found.fx
    assert [0.0 < reach < 0.02 for reach in report["radial_reach"]] == [True, True]
    assert len(report["trials"]) == said.err.count(" frames with a pose")


def test_a_principal_point_that_was_moved_is_told(images, tmp_path, capsys, monkeypatch):
    def tried(images, at: Lens, readout) -> LensTrial:
        left = (0.04 - at.centre[0], -0.02 - at.centre[1])
        error_px = 0.2 + abs(left[0]) + abs(1.1 - at.focal)
        change = LensFit(1.1 / at.focal - 1.0, centre=left, sigma_focal=0.001, sigma_centre=(0.002, 0.001))
        return LensTrial(at, CameraEvidence([], error_px, 60), change)

    monkeypatch.setattr(lens, "_tried", tried)
    out, result = tmp_path / "camera.json", tmp_path / "result.json"
    assert main(["lens", str(images), "--out", str(out), "--json", str(result)]) == 0
    said, found = capsys.readouterr(), Intrinsics.load(out)
    assert found.fx == pytest.approx(1.1 * 26.5)
    assert (found.cx, found.cy) == pytest.approx((15.5 + 0.04 * 26.5, 11.5 - 0.02 * 26.5))
    assert found.distortion == ()
    assert "principal point: 16.6 (+- 0.1), 11.0 (+- 0.1) px" in said.out
    assert "focal length x 1.1000, centre +0.0400 -0.0200: 60 frames with a pose" in said.err
    assert json.loads(result.read_text())["centre_reach_px"] == pytest.approx([0.13, 0.07], abs=0.02)
    result.unlink()
    with room_for(600):  # for the camera, and not for its result
        assert main(["lens", str(images), "--out", str(out), "--json", str(result)]) == 1
    unwritten = capsys.readouterr()
    assert unwritten.out == said.out
    assert f"semcast lens: {result} can't be written: " in unwritten.err
    assert not result.exists()


def test_a_fisheye_is_not_changed_as_if_it_were_a_pinhole(images, tmp_path, capsys):
    camera = tmp_path / "camera.json"
    stored = {"fx": 26.5, "fy": 26.5, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24, "is_fisheye": True}
    camera.write_text(json.dumps(stored))
    assert main(["lens", str(images), "--intrinsics", str(camera), "--out", str(tmp_path / "new.json")]) == 1
    assert "must be a pinhole with radial-tangential distortion, got equidistant" in capsys.readouterr().err
    assert not (tmp_path / "new.json").exists()


def test_bounds_hold_what_is_not_modelled_besides_chance(images, monkeypatch):
    def told(unit):
        change = LensFit(
            0.0, sigma_focal=0.005, sigma_radial=(0.002, 0.0), sigma_centre=(0.001, 0.001), unit=unit
        )
        bent = Lens(1.0, (0.05, 0.0), (0.01, 0.0))
        trial = LensTrial(bent, CameraEvidence([], 0.2, 60), change)
        monkeypatch.setattr(lens, "_tried", lambda *_: trial)
        return lens.find_lens(settings_of(images))

    chance, both = told((0.0,) * 5), told((0.2, 0.5, 0.0, 0.1, 0.3))
    share = np.sqrt(0.002)
    assert both.focal_reach == pytest.approx(chance.focal_reach + 0.2 * share)
    assert both.radial_reach == pytest.approx((chance.radial_reach[0] + 0.5 * share,))
    more_px = np.subtract(both.centre_reach_px, chance.centre_reach_px)
    assert more_px == pytest.approx(26.5 * share * np.array([0.1, 0.3]))
    with pytest.raises(SemcastError, match="these images don't tell the focal length"):
        told((1.6, 0.0, 0.0, 0.0, 0.0))


def test_in_pixels_everything_else_stays_when_the_focal_length_changes():
    lens_before = Lens(1.2, (0.1, 0.02), (0.03, -0.01))
    after = lens._changed(lens_before, LensFit(0.1, (0.05, 0.0), (0.01, 0.0)))
    assert after.focal == pytest.approx(1.32)
    assert after.radial == pytest.approx((0.15 * 1.21, 0.02 * 1.21**2))
    assert after.centre == pytest.approx((0.03 + 0.01 * 1.2, -0.01))


def test_a_file_that_can_not_be_written_is_told_before_the_work(images, capsys):
    assert main(["lens", str(images), "--out", "camera.yaml"]) == 1
    assert "out must be a .json file, got camera.yaml" in capsys.readouterr().err
