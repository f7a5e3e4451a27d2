"""What a run leaves behind can be read by others."""

import json

import numpy as np
import pytest
from full_disk import room_for

from semcast.common.trajectory import Trajectory, read_tum, write_tum
from semcast.server.export.outputs import (
    EachFile,
    plain,
    read_ply,
    trajectory_of,
    versions,
    write_json,
    write_ply,
)


def test_ply_is_what_the_format_says_byte_for_byte(tmp_path):
    path = tmp_path / "map.ply"
    write_ply(path, [[1.0, 2.0, 3.0]], np.array([[10, 20, 30]], np.uint8), np.array([0.5], np.float32))
    header, body = path.read_bytes().split(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert b"element vertex 1\n" in header
    assert b"property float x\n" in header
    assert b"property uchar red\n" in header
    assert (
        body == np.array([1, 2, 3], "<f4").tobytes() + bytes([10, 20, 30]) + np.array([0.5], "<f4").tobytes()
    )


def test_ply_round_trip_leaves_out_points_at_infinity(tmp_path, read_ply):
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(50, 3))
    xyz[7, 1] = np.inf
    rgb = rng.integers(0, 255, (50, 3), dtype=np.uint8)
    write_ply(tmp_path / "map.ply", xyz, rgb, rng.random(50, dtype=np.float32))
    vertices = read_ply(tmp_path / "map.ply")
    kept = np.arange(50) != 7
    np.testing.assert_allclose(np.stack([vertices[a] for a in "xyz"], axis=1), xyz[kept].astype(np.float32))
    assert vertices["green"].tolist() == rgb[kept, 1].tolist()


def test_ply_of_an_empty_map_is_valid(tmp_path, read_ply):
    write_ply(tmp_path / "map.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32))
    assert len(read_ply(tmp_path / "map.ply")) == 0


@pytest.mark.parametrize("shift", [(0, 0, 0), (692e3, 5_334e3, 520)], ids=["map", "satellites"])
def test_points_far_from_the_origin_keep_their_distances(tmp_path, shift):
    xyz = np.random.default_rng(0).normal(size=(50, 3)) + shift
    write_ply(tmp_path / "map.ply", xyz, np.zeros((50, 3), np.uint8), np.ones(50, np.float32))
    cloud = read_ply(tmp_path / "map.ply")
    np.testing.assert_allclose(np.stack([cloud[a] for a in "xyz"], axis=1) - shift, xyz - shift, atol=1e-6)
    assert cloud["confidence"].tolist() == [1.0] * 50
    kind = b"double" if any(shift) else b"float"
    assert b"property " + kind + b" x\n" in (tmp_path / "map.ply").read_bytes()


def test_ply_opens_in_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rgb = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    write_ply(tmp_path / "map.ply", [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], rgb, np.ones(2, np.float32))
    model = pycolmap.Reconstruction()
    model.import_PLY(str(tmp_path / "map.ply"))
    points = sorted(model.points3D.values(), key=lambda p: p.xyz[0])
    assert [p.xyz.tolist() for p in points] == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert [p.color.tolist() for p in points] == rgb.tolist()


def test_a_full_disk_leaves_the_results_of_before(tmp_path, read_ply):
    xyz, rgb, confidence = np.ones((100, 3)), np.zeros((100, 3), np.uint8), np.ones(100, np.float32)
    write_ply(tmp_path / "map.ply", xyz[:1], rgb[:1], confidence[:1])
    write_tum(tmp_path / "t.tum", Trajectory(np.zeros(1), np.eye(4)[None]))
    with room_for(512):
        with pytest.raises(OSError, match="File too large"):
            write_ply(tmp_path / "map.ply", xyz, rgb, confidence)
        with pytest.raises(OSError, match="File too large"):
            write_tum(tmp_path / "t.tum", Trajectory(np.arange(100.0), np.tile(np.eye(4), (100, 1, 1))))
    assert len(read_ply(tmp_path / "map.ply")) == 1
    assert len(read_tum(tmp_path / "t.tum")) == 1
    assert len(list(tmp_path.iterdir())) == 2


def test_trajectories_are_ordered_by_frame_and_never_go_back_in_time():
    def pose(x):
        T = np.eye(4)
        T[0, 3] = x
        return T

    trajectory = trajectory_of(
        {5: pose(5), 1: pose(1), 2: pose(2), 3: pose(3), 9: pose(9)},
        {1: 1_000_000_000, 3: 3_000_000_000, 5: 2_000_000_000, 7: 0},
    )
    assert trajectory.t_s.tolist() == [1.0, 3.0]
    assert trajectory.positions[:, 0].tolist() == [1.0, 3.0]
    assert len(trajectory_of({}, {})) == 0


def test_json_has_no_nan(tmp_path):
    value = {"a": float("nan"), "b": [np.float32(1.5), np.inf], "c": np.arange(2), 3: (tmp_path,), "d": None}
    write_json(tmp_path / "summary.json", value)
    read = json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert read == {"a": None, "b": [1.5, None], "c": [0, 1], "3": [str(tmp_path)], "d": None}
    assert list(tmp_path.iterdir()) == [tmp_path / "summary.json"]
    assert plain(True) is True


def test_versions_name_what_figures_depend_on():
    assert {"semcast", "python", "numpy"} <= set(versions())


def written_each(folder, errors, at_the_end=None):
    """Return which files are written where others, and what follows them, fail with these errors."""
    written, failure = [], None
    try:
        with EachFile() as files:
            for name, error in errors.items():
                with files.attempt(folder / name) as path:
                    if error is not None:
                        raise error
                    written.append(path.name)
            if at_the_end is not None:
                raise at_the_end
    except (OSError, KeyError) as err:
        failure = err
    return written, failure


def test_a_file_that_can_not_be_written_costs_no_other_and_hides_no_other_error(tmp_path):
    errors = {"a": OSError(28, "No space left"), "b": None, "c": ValueError("that is no map")}
    written, failure = written_each(tmp_path, errors)
    assert written == ["b"]
    assert str(failure) == "a: No space left; c: that is no map"
    other = KeyError("k")
    assert written_each(tmp_path, errors, at_the_end=other) == (["b"], other)
    assert written_each(tmp_path, {"b": None}) == (["b"], None)
