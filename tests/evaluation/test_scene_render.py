"""Drawn sequences are read back as recordings, and the reconstruction finds their path."""

import copy
import filecmp
import functools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semcast.common.errors import SourceError
from semcast.common.geometry import rotation_angle_deg
from semcast.common.sequence import open_sequence
from semcast.evaluation.scenes.motion import Pace
from semcast.evaluation.scenes.render import SCENES, RenderSettings, Scene, SceneName, frame_of, render_scene
from semcast.evaluation.scenes.street import Street
from semcast.evaluation.scenes.surfaces import exact_depth
from semcast.evaluation.trajectory import TrajectorySettings, evaluate_trajectory


@functools.cache
def scene_of(name: SceneName, seed: int = 0, pace: Pace = "normal") -> Scene:
    """Make a scene once: painting its surfaces takes longer than drawing a picture of them."""
    return SCENES[name](seed, pace)


class Painted:
    """Stands for the class of a scene that was painted before."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.camera, self.rate_hz = scene.camera, scene.rate_hz

    def __call__(self, seed: int, pace: Pace) -> Scene:
        assert (seed, pace) == (0, "normal")
        return copy.copy(self._scene)


@pytest.fixture
def painted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings be drawn of the still life that was painted before, each with a camera of its own."""
    monkeypatch.setitem(SCENES, "orbit", Painted(scene_of("orbit")))


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> Iterator[None]:
    """Let scenes go when they were all looked at: each holds a hundred megabytes."""
    yield
    scene_of.cache_clear()


@pytest.fixture(scope="module")
def orbit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "orbit"
    render_scene(RenderSettings(scene="orbit", seconds=1.0, out=folder))
    return folder


def test_a_drawn_sequence_is_a_recording_with_an_exact_path(orbit: Path) -> None:
    sequence = open_sequence(orbit)
    truth = sequence.groundtruth()
    assert truth is not None
    assert len(truth) == 10
    scene = scene_of("orbit")
    np.testing.assert_allclose(truth.T_world_cam[7], scene.T_world_cam(0.7), atol=1e-6)
    assert sequence.intrinsics == scene.camera


def test_the_reconstruction_finds_the_drawn_path(orbit: Path) -> None:
    report = evaluate_trajectory(TrajectorySettings(sequence=orbit, codec="none"))
    assert report["completeness"] == 1.0
    assert report["ate_percent"] < 1.0


def test_the_same_settings_give_the_same_files(orbit: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    render_scene(RenderSettings(scene="orbit", seconds=0.2, out=again))
    for name in ("000000.png", "000001.png"):
        assert filecmp.cmp(orbit / "images" / name, again / "images" / name, shallow=False)


def test_a_disk_without_room_is_said_with_its_reason(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], painted_once: None
) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, before[1]))
    try:
        with pytest.raises(SourceError, match=r"can't write to .*: File too large"):
            render_scene(RenderSettings(scene="orbit", seconds=0.1, out=tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not capfd.readouterr().err


def test_a_folder_with_files_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = RenderSettings(seconds=0.1, out=tmp_path)
    monkeypatch.setitem(SCENES, "room", lambda *_: pytest.fail("seconds of painting for nothing"))
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(SourceError, match="has files in it"):
        render_scene(settings)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("name", sorted(SCENES))
def test_scenes_fill_the_view_and_cameras_move_smoothly(name: SceneName) -> None:
    scene = scene_of(name)
    image = frame_of(scene, 2.0, 0.0, np.random.default_rng(0))
    assert image.shape == (scene.camera.height, scene.camera.width, 3)
    assert image.std() > 10
    times_s = np.arange(0, 20, 1 / scene.rate_hz)
    positions = np.stack([scene.T_world_cam(t_s)[:3, 3] for t_s in times_s])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    # No standing still, and no jump: 15 m/s is the fastest any of them goes.
    assert np.median(steps) > 0
    assert steps.max() < 15 / scene.rate_hz


@pytest.mark.parametrize("name", ["street", "lorry", "block"])
def test_a_drive_goes_on_to_the_end_of_the_longest_recording_or_is_refused(
    name: SceneName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(name)
    assert isinstance(scene, Street)
    end_s = min(scene.lasts_s, 120.0)
    before, at_end = (scene.T_world_cam(end_s - ago_s)[:3, 3] for ago_s in (0.5, 0.0))
    assert np.linalg.norm(at_end - before) > 1.5, "a car brakes from 10 m/s in more than no time"
    if name == "lorry":
        rear_m = [s.corner_m for s in scene.surfaces(end_s)[-6:]]
        assert np.linalg.norm(np.mean(rear_m, axis=0) - at_end) > 8.0, "and is not driven into"
    if scene.lasts_s >= 120.0:
        return
    monkeypatch.setitem(SCENES, name, Painted(scene))
    with pytest.raises(SourceError, match=r"seconds must be at most 7\d on this road, .*, got 100"):
        render_scene(RenderSettings(scene=name, seconds=100.0, out=tmp_path / "x"))
    assert not (tmp_path / "x").exists()


def test_a_drive_round_the_block_ends_where_it_began() -> None:
    scene = scene_of("block")
    poses = np.stack([scene.T_world_cam(t_s) for t_s in np.arange(0, 44, 0.1)])
    away_m = np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1)
    assert away_m.max() > 40
    again = 200 + int(np.argmin(away_m[200:]))
    assert again < len(poses) - 50, "and goes on"
    assert away_m[again] < 1.0
    assert rotation_angle_deg(poses[again, :3, :3].T @ poses[0, :3, :3]) < 3


def test_a_walk_round_the_office_passes_bare_corners_and_shelves() -> None:
    scene = scene_of("office")
    small = replace(scene.camera, fx=53.0, fy=53.0, cx=31.5, cy=23.5, width=64, height=48)

    # Neither walls, floor and ceiling nor what is narrow, as sockets and skirting boards are.
    large = [
        s for s in scene.surfaces(0.0)[6:] if np.linalg.norm([s.edge_u_m, s.edge_v_m], axis=1).min() > 0.1
    ]
    shares = np.array(
        [
            np.isfinite(exact_depth(large, small, scene.T_world_cam(t_s))).mean()
            for t_s in np.arange(0, 30, 0.25)
        ]
    )
    bare_s = [0.25 * len(corner) for corner in "".join(" b"[int(x < 0.04)] for x in shares).split()]
    assert len(bare_s) >= 3
    assert 0.5 <= np.median(bare_s) <= 1.5
    assert np.median(shares) > 0.15
    assert shares.max() > 0.5, "before a shelf"
    assert rotation_angle_deg(scene.T_world_cam(30.0)[:3, :3].T @ scene.T_world_cam(0.0)[:3, :3]) < 40


def test_seeds_and_paces_differ() -> None:
    one, other = scene_of("corridor"), scene_of("corridor", 1)
    assert not np.allclose(one.T_world_cam(1.0), other.T_world_cam(1.0))
    gentle, fast = (scene_of("corridor", pace=pace) for pace in ("gentle", "fast"))
    times_s = np.arange(0, 5, 0.1)
    paths = [np.stack([scene.T_world_cam(t)[:3, 3] for t in times_s]) for scene in (gentle, fast)]
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths]
    assert lengths[1] > 2 * lengths[0]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"seconds": 0}, r"seconds must be in \(0, 120\], got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"noise_sd": 60}, r"noise_sd must be in \[0, 50\], got 60"),
        ({"brightness": 0}, r"brightness must be in \(0, 1\], got 0"),
        ({"brightness": 1.5}, r"brightness must be in \(0, 1\], got 1.5"),
        ({"distortion": (0.1, float("nan"), 0, 0)}, "4, 5 or 8 finite values, got .*nan"),
        ({"distortion": (0.1, float("inf"), 0, 0)}, "4, 5 or 8 finite values, got .*inf"),
    ],
)
def test_settings_out_of_range_are_refused(values: dict[str, float], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        RenderSettings(out=tmp_path / "x", **values)  # type: ignore[arg-type]


def test_a_night_has_less_light_and_the_same_noise() -> None:
    scene = scene_of("room")
    day, night = (
        frame_of(scene, 1.0, 2.0, np.random.default_rng(0), brightness=share).astype(float)
        for share in (1.0, 0.2)
    )
    clear = frame_of(scene, 1.0, 0.0, np.random.default_rng(0)).astype(float)
    bright = (clear > 60) & (clear < 240)
    np.testing.assert_allclose(np.std((night - 0.2 * clear)[bright]), 2.0, rtol=0.1)
    np.testing.assert_allclose(np.std((day - clear)[bright]), 2.0, rtol=0.1)


def test_the_camera_of_a_rolling_shutter_says_so(tmp_path: Path, painted_once: None) -> None:
    folder = tmp_path / "rolling"
    render_scene(RenderSettings(scene="orbit", seconds=0.1, readout_ms=12.5, out=folder))
    camera = open_sequence(folder).intrinsics
    assert (camera.readout_ms, camera.readout_from) == (12.5, "top")


def test_a_rolling_shutter_is_through_before_the_next_frame(tmp_path: Path) -> None:
    for scene, fits_ms, too_long_ms in (("room", 33.0, 34.0), ("street", 100.0, 101.0)):
        assert RenderSettings(scene=scene, readout_ms=fits_ms, out=tmp_path).readout_ms == fits_ms
        with pytest.raises(ValueError, match=rf"readout_ms must be in \[0, .*\] for scene '{scene}', got"):
            RenderSettings(scene=scene, readout_ms=too_long_ms, out=tmp_path)


def test_rows_of_a_rolling_shutter_are_drawn_at_their_times() -> None:
    scene = scene_of("room", pace="fast")
    rng = np.random.default_rng(0)
    rolled = frame_of(scene, 1.0, 0.0, rng, readout_s=0.06)
    height = scene.camera.height
    for share in (0.0, 0.5, 1.0):
        top = round(share * (height - height // 24))
        rows = slice(top, top + height // 24)
        late_s = 0.06 * ((top + height // 48) / height - 0.5)
        at_its_time, at_another = (frame_of(scene, 1.0 + s, 0.0, rng)[rows] for s in (late_s, late_s + 0.03))
        error, other = (
            np.abs(rolled[rows].astype(int) - image).mean() for image in (at_its_time, at_another)
        )
        assert error < 0.1 * other


def test_a_lorry_goes_ahead_of_the_camera_and_hides_the_end_of_the_street() -> None:
    scene, street = scene_of("lorry"), scene_of("street")
    for t_s in (0.0, 4.0, 8.0):
        lorry = scene.surfaces(t_s)[-6:]
        middle = np.mean([s.corner_m + (s.edge_u_m + s.edge_v_m) / 2 for s in lorry], axis=0)
        T_world_cam = scene.T_world_cam(t_s)
        assert np.allclose(T_world_cam, street.T_world_cam(t_s))
        forward_m = T_world_cam[:3, 2] @ (middle - T_world_cam[:3, 3])
        assert 9 < forward_m < 15
    rng = np.random.default_rng(0)
    hidden = np.abs(frame_of(scene, 0.0, 0.0, rng).astype(float) - frame_of(street, 0.0, 0.0, rng)) > 8
    height, width = hidden.shape[:2]
    assert hidden[height // 2 - 20 : height // 2 + 20, width // 2 - 60 : width // 2 + 60].mean() > 0.7
    assert 0.05 < hidden.mean() < 0.4
