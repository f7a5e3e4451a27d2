"""Runs brought to metres: by a known path, by a marker in the pictures."""

import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from drawn_markers import FAMILY, draw_marker

from semcast.cli import main
from semcast.common.camera import Intrinsics
from semcast.common.errors import ConfigError, SourceError
from semcast.common.geometry import (
    exp_so3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
    transform_points,
)
from semcast.common.run_folder import PartInMetres, read_image_paths, read_run, write_run
from semcast.common.trajectory import Trajectory, read_tum, write_tum
from semcast.server.export.markers import Sightings, place_by_marker
from semcast.server.export.outputs import write_ply
from semcast.server.export.placement import place_by_path
from semcast.server.image_writer import ImageWriter

CAMERA = Intrinsics(fx=420.0, fy=430.0, cx=310.0, cy=235.0, width=640, height=480)
#: Metres per unit of the map of these runs.
SCALE = 0.2
R_METRES_MAP, T_METRES_MAP = exp_so3((0.4, -1.1, 0.3)), np.array([3.0, -7.0, 2.0])


def in_metres(T_world_cam):
    """Return poses in another frame and unit."""
    placed = T_world_cam.copy()
    placed[:, :3, :3] = R_METRES_MAP @ T_world_cam[:, :3, :3]
    placed[:, :3, 3] = SCALE * T_world_cam[:, :3, 3] @ R_METRES_MAP.T + T_METRES_MAP
    return placed


def known_path(data):
    return Trajectory(data.t_source_ns * 1e-9, in_metres(data.T_world_cam))


def test_a_run_takes_over_frame_and_unit_of_a_known_path(arc_run):
    data = arc_run()
    placement = place_by_path(data, known_path(data))
    assert placement.scale == pytest.approx(SCALE)
    placed = placement.run(data)
    np.testing.assert_allclose(placed.T_world_cam, in_metres(data.T_world_cam), atol=1e-9)
    np.testing.assert_allclose(placed.xyz, SCALE * data.xyz @ R_METRES_MAP.T + T_METRES_MAP, atol=1e-9)
    np.testing.assert_array_equal(placed.observed_xy, data.observed_xy)
    # Nothing says that the path is in metres.
    assert re.fullmatch(
        r"aligned with 9 known poses, \S+ units of the path apart \(RMS\); "
        r"1 unit of the map is 0\.2 units of the path",
        placement.words,
    )


def test_a_path_is_known_at_other_times_and_in_part_of_the_run(arc_run):
    data = arc_run(num_frames=40)  # frame ids from 3 on, ten a second
    known = known_path(data)
    rows = np.arange(10, 30, 2)
    placement = place_by_path(data, Trajectory(known.t_s[rows], known.T_world_cam[rows]))
    assert placement.scale == pytest.approx(SCALE, rel=1e-3)
    assert "aligned with 19 known poses" in placement.words


def test_frames_of_a_source_that_began_anew_are_placed_but_not_aligned(arc_run):
    data = arc_run(num_frames=12)
    known = known_path(data)
    again = data.t_source_ns.copy()
    again[8:] = again[:4]
    data = replace(data, t_source_ns=again)
    placement = place_by_path(data, known)
    assert placement.words.startswith("aligned with 8 known poses, ")
    np.testing.assert_allclose(placement.run(data).T_world_cam, in_metres(data.T_world_cam), atol=1e-9)


def straight(data):
    T = data.T_world_cam.copy()
    T[:, :3, 3] = np.linspace(0, 4, len(T))[:, None] * np.array([0.1, 0.0, 1.0])
    return replace(data, T_world_cam=T)


def test_on_a_straight_path_directions_say_what_is_up(arc_run):
    data = straight(arc_run())
    placement = place_by_path(data, known_path(data))
    np.testing.assert_allclose(placement.run(data).T_world_cam, in_metres(data.T_world_cam), atol=1e-6)


def test_on_a_straight_path_positions_stay_exact_where_directions_are_a_little_off(arc_run):
    data = straight(arc_run())
    known = known_path(data)
    known.T_world_cam[:, :3, :3] = exp_so3((0.06, 0.05, -0.04)) @ known.T_world_cam[:, :3, :3]
    placement = place_by_path(data, known)
    placed = placement.run(data).T_world_cam
    np.testing.assert_allclose(placed[:, :3, 3], known.positions, atol=1e-9)
    assert 0.5 < rotation_angle_deg(placement.R @ R_METRES_MAP.T) < 5.0


def test_noise_of_a_known_straight_path_does_not_say_what_is_up(arc_run):
    data = straight(arc_run(num_frames=30))
    known = known_path(data)
    known.T_world_cam[:, :3, 3] += np.random.default_rng(2).normal(0, 0.02, (30, 3))  # of 0.8 m
    placement = place_by_path(data, known)
    assert rotation_angle_deg(placement.R @ R_METRES_MAP.T) < 5.0


def test_directions_of_something_else_than_the_camera_do_not_tip_a_straight_path_over(arc_run):
    data = straight(arc_run())
    known = known_path(data)
    known.T_world_cam[:, :3, :3] = known.T_world_cam[:, :3, :3] @ exp_so3((0.0, np.pi / 2, 0.0))
    with pytest.raises(SourceError, match="straight, so its directions must be those of the camera"):
        place_by_path(data, known)
    bent = straight(arc_run())
    bent.T_world_cam[:, 1, 3] = 0.1 * np.arange(9) ** 2
    known = known_path(bent)
    known.T_world_cam[:, :3, :3] = known.T_world_cam[:, :3, :3] @ exp_so3((0.0, np.pi / 2, 0.0))
    assert place_by_path(bent, known).scale == pytest.approx(SCALE)  # its positions say enough


def test_a_path_of_another_time_or_of_one_place_is_refused(arc_run):
    data = arc_run()
    late = Trajectory(data.t_source_ns * 1e-9 + 100, data.T_world_cam)
    first_s, last_s = data.t_source_ns[[0, -1]] * 1e-9
    with pytest.raises(SourceError, match="time of 3 posed frames or more, got 0 of 9") as refused:
        place_by_path(data, late)
    assert f"it has {100 + first_s:.1f} to {100 + last_s:.1f} s, the frames {first_s:.1f} to" in str(
        refused.value
    )
    two = Trajectory(data.t_source_ns[:2] * 1e-9, data.T_world_cam[:2])
    with pytest.raises(SourceError, match="got 2 of 9"):
        place_by_path(data, two)
    still = Trajectory(data.t_source_ns * 1e-9, np.repeat(data.T_world_cam[:1], 9, axis=0))
    with pytest.raises(SourceError, match="camera must move"):
        place_by_path(data, still)


#: Faces the cameras, a little turned: its z points back to them.
T_MAP_MARKER = make_transform(exp_so3((0.2, 0.1, 0.3)) @ np.diag([1.0, -1.0, -1.0]), (0.1, 0.2, 6.0))
SIDE = 1.5
SQUARE = 0.5 * SIDE * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


@pytest.fixture
def marker_run(tmp_path, arc_run):
    """Write a run whose images show marker 7; arguments change what they show."""

    def make(markers=((7, T_MAP_MARKER, SIDE),), data=None, elsewhere=None):
        data = replace(arc_run(num_frames=12) if data is None else data, intrinsics=CAMERA)
        write_run(tmp_path / "run", data)
        rng = np.random.default_rng(5)
        with ImageWriter(tmp_path / "run", lossless=True) as writer:
            for frame_id, T in zip(data.frame_ids.tolist(), invert_transform(data.T_world_cam), strict=True):
                noise = rng.normal(120, 12, (CAMERA.height, CAMERA.width, 3))
                image = np.clip(noise, 0, 255).astype(np.uint8)
                for number, place, side in markers:
                    shown = elsewhere[1] if elsewhere is not None and frame_id == elsewhere[0] else place
                    image = draw_marker(image, CAMERA, T @ shown, side, number)
                writer.put(frame_id, image)
        return data, read_image_paths(tmp_path / "run")

    return make


def expected_cameras(data, T_map_marker=T_MAP_MARKER):
    """Return where cameras are in the frame of the marker, metres."""
    return SCALE * (invert_transform(T_map_marker) @ data.T_world_cam)[:, :3, 3]


def test_a_marker_gives_metres_and_its_own_axes(marker_run):
    data, images = marker_run()
    placement = place_by_marker(data, images, SIDE * SCALE, FAMILY)
    assert placement.scale == pytest.approx(SCALE, rel=3e-3)
    placed = placement.run(data)
    np.testing.assert_allclose(placed.T_world_cam[:, :3, 3], expected_cameras(data), atol=8e-3)
    assert (placed.T_world_cam[:, 2, 3] > 0.9).all()  # in front of the paper
    assert rotation_angle_deg(placement.R @ T_MAP_MARKER[:3, :3]) < 0.3
    assert placement.frame == "x right, y up, z out of marker 7; metres"
    assert placement.words.startswith("marker 7: 12 images, 0.")


def test_a_marker_is_found_in_images_of_a_folder_whose_name_is_no_text(marker_run, tmp_path):
    data, _ = marker_run()
    folder = (tmp_path / "run").rename(tmp_path / os.fsdecode(b"run\xff"))
    placement = place_by_marker(data, read_image_paths(folder), SIDE * SCALE, FAMILY)
    assert placement.scale == pytest.approx(SCALE, rel=3e-3)


def test_the_stated_uncertainty_covers_the_error_and_is_not_idle(marker_run):
    data, images = marker_run()
    placement = place_by_marker(data, images, SIDE * SCALE, FAMILY)
    within = float(placement.words.split("within ")[1].split(" %")[0]) / 100
    assert 0.0003 < within < 0.01
    assert abs(np.log(placement.scale / SCALE)) <= within


def test_an_image_that_shows_the_marker_elsewhere_is_left_out(marker_run):
    moved = make_transform(T_MAP_MARKER[:3, :3], T_MAP_MARKER[:3, 3] + (0.8, -0.5, 0.0))
    data, images = marker_run(elsewhere=(8, moved))
    placement = place_by_marker(data, images, SIDE * SCALE, FAMILY)
    assert placement.words.startswith("marker 7: 11 images")
    assert placement.scale == pytest.approx(SCALE, rel=3e-3)


def test_of_several_markers_one_may_be_named(marker_run):
    other = make_transform(T_MAP_MARKER[:3, :3], T_MAP_MARKER[:3, 3] + (-1.9, 0.0, 0.5))
    data, images = marker_run(markers=((7, T_MAP_MARKER, SIDE), (3, other, 0.75 * SIDE)))
    placement = place_by_marker(data, images, 0.75 * SIDE * SCALE, FAMILY, marker_id=3)
    assert placement.scale == pytest.approx(SCALE, rel=5e-3)
    np.testing.assert_allclose(
        placement.points(data.T_world_cam[:, :3, 3]), expected_cameras(data, other), atol=2e-2
    )
    with pytest.raises(SourceError, match=r"marker 5 of apriltag_36h11 .* got none of 12; found: 3, 7$"):
        place_by_marker(data, images, 0.3, FAMILY, marker_id=5)


def test_of_several_markers_the_one_counts_that_tells_the_scale_and_is_in_most_images(arc_run):
    data = arc_run(num_frames=6)
    poses = dict(enumerate(data.T_world_cam))
    sightings = Sightings(FAMILY)
    for number, x, frame_ids in ((3, -2.0, range(6)), (9, 0.0, range(4)), (5, -1.0, range(5))):
        T_map_marker = make_transform(T_MAP_MARKER[:3, :3], (x, 0.0, 6.0))
        T_cam_marker = invert_transform(data.T_world_cam) @ T_map_marker
        sightings.of[number] = {
            k: CAMERA.project(transform_points(T_cam_marker[k], SQUARE)) for k in frame_ids
        }
    assert sightings.place(poses, CAMERA, SIDE * SCALE, None).marker_id == 3
    for k in range(6):
        sightings.of[3][k] = sightings.of[3][k] + 40.0 * k  # carried about
    assert sightings.place(poses, CAMERA, SIDE * SCALE, None).marker_id == 5
    for number in (5, 9):
        del sightings.of[number]
    with pytest.raises(SourceError, match="marker 3 must be seen from several places"):
        sightings.place(poses, CAMERA, SIDE * SCALE, None)


def test_a_marker_seen_from_one_place_tells_no_scale(marker_run, arc_run):
    data = arc_run(num_frames=5)
    data = replace(data, T_world_cam=np.repeat(data.T_world_cam[:1], 5, axis=0))
    data.T_world_cam[:, 0, 3] += 0.001 * np.arange(5)
    data, images = marker_run(data=data)
    with pytest.raises(SourceError, match=r"must be seen from several places .* leave it open by \d+ %"):
        place_by_marker(data, images, 0.3, FAMILY)


@pytest.mark.parametrize("step", [0.0, 1e-5])
def test_a_camera_that_only_turns_tells_no_scale(marker_run, arc_run, step):
    data = arc_run(num_frames=5)
    T_world_cam = [make_transform(exp_so3((0.02 * k, 0.0, 0.0)), (step * k, 0.0, 0.0)) for k in range(5)]
    data, images = marker_run(data=replace(data, T_world_cam=np.stack(T_world_cam)))
    with pytest.raises(SourceError, match="must be seen from several places to tell the scale"):
        place_by_marker(data, images, 0.3, FAMILY)


def test_what_a_marker_needs_is_said(marker_run):
    data, images = marker_run()
    few = dict(list(images.items())[:2])
    with pytest.raises(SourceError, match="marker 7 must be seen alike in 3 images or more, got 2 of 2"):
        place_by_marker(data, few, 0.3, FAMILY)
    with pytest.raises(SourceError, match=r"marker of any number of 4x4_50 must be .* none of 12"):
        place_by_marker(data, images, 0.3, "4x4_50")
    with pytest.raises(ConfigError, match=r"dictionary must be one of .*4x4_50.*, got 'qr'"):
        place_by_marker(data, images, 0.3, "qr")
    with pytest.raises(ConfigError, match=r"side of the marker must be above 0 m, got -0.1"):
        place_by_marker(data, images, -0.1, FAMILY)
    with pytest.raises(SourceError, match="kept no images"):
        place_by_marker(data, {}, 0.3, FAMILY)
    with pytest.raises(SourceError, match="must be an image of 640x481"):
        place_by_marker(replace(data, intrinsics=replace(CAMERA, height=481)), images, 0.3, FAMILY)


def export(tmp_path, *options):
    return main(["export", str(tmp_path / "run"), *map(str, options)])


def test_all_files_of_an_export_are_in_metres(tmp_path, marker_run, read_ply, capsys):
    data, _ = marker_run()
    write_ply(tmp_path / "run" / "dense.ply", data.xyz, data.rgb, data.confidence)
    marker = ("--marker-m", SIDE * SCALE)
    assert export(tmp_path, "--format", "tum", "--out", tmp_path / "m.tum", *marker) == 0
    assert re.search(r"1 unit of the map is 0\.(2|199|200)\d* m, within ", capsys.readouterr().err)
    path = read_tum(tmp_path / "m.tum")
    np.testing.assert_allclose(path.positions, expected_cameras(data), atol=8e-3)

    for name in ("ply", "dense"):
        assert export(tmp_path, "--format", name, "--out", tmp_path / f"{name}.ply", *marker) == 0
        cloud = read_ply(tmp_path / f"{name}.ply")
        expected = SCALE * (data.xyz - T_MAP_MARKER[:3, 3]) @ T_MAP_MARKER[:3, :3]
        np.testing.assert_allclose(np.stack([cloud[a] for a in "xyz"], axis=1), expected, atol=1e-2)
        np.testing.assert_array_equal(cloud["green"], data.rgb[:, 1])
        assert (
            b"comment semcast map; x right, y up, z out of marker 7; metres"
            in (tmp_path / f"{name}.ply").read_bytes()
        )

    assert export(tmp_path, "--format", "nerfstudio", "--out", tmp_path / "ns", *marker) == 0
    transforms = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    assert transforms["applied_transform"] == np.eye(4)[:3].tolist()
    centres = np.array([np.array(f["transform_matrix"])[:3, 3] for f in transforms["frames"]])
    np.testing.assert_allclose(centres, expected_cameras(data), atol=8e-3)


def test_an_export_is_in_the_unit_that_the_run_itself_found(tmp_path, marker_run, read_ply, capsys):
    data, _ = marker_run(markers=())
    T_marker_world = invert_transform(T_MAP_MARKER)
    T_marker_world[:3, 3] *= SCALE
    metres = {"marker_id": 7, "num_keyframes": 5, "m_per_unit": SCALE, "relative_sigma": 0.01}
    known = PartInMetres(part=0, T_marker_world=T_marker_world, **metres)
    write_run(tmp_path / "run", replace(data, metres=(known,)))
    write_ply(tmp_path / "run" / "dense.ply", data.xyz, data.rgb, data.confidence)

    assert export(tmp_path, "--format", "tum", "--out", tmp_path / "u.tum") == 0
    assert "the run knows the metre: --metres writes in it" in capsys.readouterr().err
    np.testing.assert_allclose(read_tum(tmp_path / "u.tum").positions, data.T_world_cam[:, :3, 3], atol=1e-7)
    assert export(tmp_path, "--format", "tum", "--metres", "--out", tmp_path / "m.tum") == 0
    assert "1 unit of the map is 0.2 m, within 2 % (95 %)" in capsys.readouterr().err
    np.testing.assert_allclose(read_tum(tmp_path / "m.tum").positions, expected_cameras(data), atol=1e-7)
    assert export(tmp_path, "--format", "dense", "--metres", "--out", tmp_path / "m.ply") == 0
    cloud = read_ply(tmp_path / "m.ply")
    expected = SCALE * (data.xyz - T_MAP_MARKER[:3, 3]) @ T_MAP_MARKER[:3, :3]
    np.testing.assert_allclose(np.stack([cloud[a] for a in "xyz"], axis=1), expected, atol=1e-5)
    assert b"x right, y up, z out of marker 7; metres" in (tmp_path / "m.ply").read_bytes()


def test_a_part_whose_unit_the_run_did_not_find_is_not_written_in_metres(tmp_path, marker_run, capsys):
    data, _ = marker_run(markers=())
    out = ("--format", "tum", "--metres", "--out", tmp_path / "x")
    assert export(tmp_path, *out) == 1
    assert "the run does not know the metre of part 0: run again with --marker-m" in capsys.readouterr().err
    metres = {"marker_id": 7, "num_keyframes": 5, "m_per_unit": SCALE, "relative_sigma": 0.01}
    known = PartInMetres(part=1, T_marker_world=np.eye(4), **metres)
    write_run(tmp_path / "run", replace(data, frame_submap=np.repeat([0, 1], [6, 6]), metres=(known,)))
    assert export(tmp_path, *out) == 1
    assert "--part must name one part" in capsys.readouterr().err
    assert export(tmp_path, *out, "--part", 0) == 1
    assert "the metre of part 0, only of part 1: run again" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    assert export(tmp_path, "--format", "tum", "--part", 0, "--out", tmp_path / "y") == 0
    assert "the run knows the metre" not in capsys.readouterr().err
    assert export(tmp_path, *out, "--part", 1) == 0
    np.testing.assert_allclose(
        read_tum(tmp_path / "x").positions, SCALE * data.T_world_cam[6:, :3, 3], atol=1e-7
    )


def test_an_export_aligned_with_a_tum_file(tmp_path, marker_run):
    data, _ = marker_run()
    write_tum(tmp_path / "known.tum", known_path(data))
    options = ("--align", tmp_path / "known.tum")
    assert export(tmp_path, "--format", "tum", "--out", tmp_path / "a.tum", *options) == 0
    written = read_tum(tmp_path / "a.tum").T_world_cam
    np.testing.assert_allclose(written, in_metres(data.T_world_cam), atol=1e-7)


def test_placements_that_can_not_be_are_refused_in_one_line(tmp_path, marker_run, capsys):
    data, _ = marker_run()
    out = ("--out", tmp_path / "x")
    assert export(tmp_path, "--format", "rrd", "--marker-m", 0.3, *out) == 1
    assert "shows the map in its own frame" in capsys.readouterr().err
    assert export(tmp_path, "--format", "tum", "--marker-id", 3, *out) == 1
    assert capsys.readouterr().err == "semcast export: --marker-id needs --marker-m\n"
    assert export(tmp_path, "--format", "dense", *out) == 1
    assert "has no dense cloud" in capsys.readouterr().err

    submap = np.repeat([0, 1], [6, 6])
    write_run(tmp_path / "run", replace(read_run(tmp_path / "run"), frame_submap=submap))
    assert export(tmp_path, "--format", "tum", "--marker-m", 0.3, *out) == 1
    assert "--part must name one part" in capsys.readouterr().err
    write_ply(tmp_path / "run" / "dense.ply", data.xyz, data.rgb, data.confidence)
    assert export(tmp_path, "--format", "dense", "--part", "largest", *out) == 1
    assert "--part must be all for --format dense" in capsys.readouterr().err
    assert export(tmp_path, "--format", "dense", "--part", "9", *out) == 1
    assert capsys.readouterr().err == "semcast export: --part must be one of 0, 1, got 9\n"
    assert export(tmp_path, "--format", "dense", "--marker-m", 0.3, *out) == 1
    assert "--format dense can't be placed here: " in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    marker = ("--marker-m", SIDE * SCALE, "--part", "1")
    assert export(tmp_path, "--format", "tum", *marker, *out) == 0
    np.testing.assert_allclose(read_tum(tmp_path / "x").positions, expected_cameras(data)[6:], atol=1e-2)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda b: b[:-5], "is damaged: "),
        (lambda b: b + b"x" * 19, "is damaged: "),
        (lambda b: b.replace(b"confidence\n", b"trust\n", 1), "is not a cloud that semcast wrote"),
        (lambda b: b"", "is not a cloud that semcast wrote"),
    ],
)
def test_a_damaged_dense_cloud_is_named(tmp_path, marker_run, capsys, damage, said):
    data, _ = marker_run()
    dense = tmp_path / "run" / "dense.ply"
    write_ply(dense, data.xyz, data.rgb, data.confidence)
    dense.write_bytes(damage(dense.read_bytes()))
    assert export(tmp_path, "--format", "dense", "--out", tmp_path / "x.ply") == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "x.ply").exists()


def test_the_uncertainty_covers_what_corners_of_an_image_have_in_common(arc_run):
    """Errors of poses move all four alike, and soft edges all of them outwards."""
    data = arc_run(num_frames=6)
    T_cam_marker = invert_transform(data.T_world_cam) @ T_MAP_MARKER
    xy = np.stack([CAMERA.project(transform_points(T, SQUARE)) for T in T_cam_marker])
    outwards = xy - xy.mean(axis=1, keepdims=True)
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    poses = dict(enumerate(data.T_world_cam))
    rng = np.random.default_rng(0)
    errors, sigmas = [], []
    for _ in range(40):
        noise = rng.normal(0, 0.2, (len(xy), 4, 2)) + rng.normal(0, 0.2, (len(xy), 1, 2))
        sightings = Sightings(FAMILY)
        sightings.of[7] = dict(enumerate(xy + noise + 0.1 * rng.normal() * outwards))
        placement = sightings.place(poses, CAMERA, SIDE * SCALE, 7)
        errors.append(placement.scale / SCALE - 1.0)
        sigmas.append(placement.relative_sigma)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas) < 1.3
