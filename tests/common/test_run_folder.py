import dataclasses
import zipfile

import numpy as np
import pytest

from semcast import SourceError
from semcast.common.camera import Intrinsics
from semcast.common.run_folder import (
    RECONSTRUCTION_NAME,
    PartInMetres,
    RunData,
    read_image_paths,
    read_run,
    write_run,
)


def tiny_run(**changes):
    values = {
        "intrinsics": Intrinsics(fx=100, fy=90, cx=31.5, cy=23.5, width=64, height=48),
        "frame_ids": [0, 2, 5],
        "t_source_ns": [0, 200_000_000, 500_000_000],
        "T_world_cam": np.stack([np.eye(4)] * 3),
        "frame_submap": [0, 0, 3],
        "keyframe_ids": [0, 5],
        "landmark_ids": [7, 9],
        "xyz": [[0, 0, 4], [1, 0, 5]],
        "rgb": [[255, 0, 1], [2, 3, 4]],
        "confidence": [0.5, 1.0],
        "landmark_submap": [0, 3],
        "observed_landmark_ids": [7, 7, 9],
        "observed_keyframe_ids": [0, 5, 5],
        "observed_xy": [[31.5, 23.5], [30, 20], [51.5, 23.5]],
        **changes,
    }
    return RunData(**values)


def test_what_was_written_is_read_back_exactly(tmp_path):
    data = tiny_run()
    write_run(tmp_path / "run", data)
    again = read_run(tmp_path / "run")
    for field in dataclasses.fields(RunData):
        a, b = getattr(data, field.name), getattr(again, field.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        else:
            assert a == b
    assert [p.name for p in (tmp_path / "run").iterdir()] == [RECONSTRUCTION_NAME]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t_source_ns": [0, 1]}, "t_source_ns must have 3 rows"),
        ({"frame_ids": [0, 5, 5]}, "strictly increase"),
        ({"keyframe_ids": [0, 5, 6]}, r"keyframe_ids must be in frame_ids, got \[6\]"),
        ({"landmark_ids": [7, 7]}, "unique"),
        ({"observed_landmark_ids": [7, 7, 8]}, "must be in landmark_ids"),
        ({"observed_xy": [[0, 0, 0]] * 3}, r"shape \(M 2\)"),
        ({"frame_submap": [0, 0]}, "frame_submap must have 3 rows"),
        ({"landmark_submap": [0]}, "landmark_submap must have 2 rows"),
        ({"T_world_cam": np.full((3, 4, 4), np.nan)}, "finite"),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        tiny_run(**changes)


def test_a_missing_run_says_what_to_give(tmp_path):
    with pytest.raises(SourceError, match="--out"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(SourceError, match="holds no reconstruction.npz"):
        read_run(tmp_path)


def test_a_run_from_before_parts_were_told_is_one_part(tmp_path):
    write_run(tmp_path, tiny_run())
    path = tmp_path / RECONSTRUCTION_NAME
    with np.load(path) as content:
        arrays = {name: content[name] for name in content.files if not name.endswith("_submap")}
    np.savez(path, **arrays)
    data = read_run(tmp_path)
    assert data.frame_submap.tolist() == [0, 0, 0]
    assert data.landmark_submap.tolist() == [0, 0]


def test_damaged_files_are_source_errors(tmp_path):
    write_run(tmp_path, tiny_run())
    path = tmp_path / RECONSTRUCTION_NAME
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    for size in rng.integers(0, len(whole), 40):
        path.write_bytes(whole[:size])
        with pytest.raises(SourceError):
            read_run(tmp_path)
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            read_run(tmp_path)
        except SourceError:
            continue


def test_what_a_unit_is_comes_back_and_is_refused_where_it_makes_no_sense(tmp_path):
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    found = {"marker_id": 7, "num_keyframes": 5, "m_per_unit": 0.25, "relative_sigma": 0.01}
    write_run(tmp_path, tiny_run(metres=(PartInMetres(part=2, T_marker_world=T, **found),)))
    (back,) = read_run(tmp_path).metres
    assert back.to_dict() == {"part": 2, "T_marker_world": T.tolist(), **found}
    values = {"part": 2, "T_marker_world": T, **found}
    for name, wrong in (
        ("m_per_unit", 0.0),
        ("relative_sigma", np.nan),
        ("relative_sigma", np.inf),
        ("T_marker_world", np.nan * T),
    ):
        with pytest.raises(ValueError, match="metres of part 2 must be finite, and a unit above 0 m"):
            PartInMetres(**{**values, name: wrong})
    for wrong in (2.0 * T, np.diag([1.0, 1.0, -1.0, 1.0])):
        with pytest.raises(ValueError, match="T_marker_world of part 2 must hold a rotation"):
            PartInMetres(**{**values, "T_marker_world": wrong})


def test_a_pickle_inside_is_not_executed(tmp_path):
    write_run(tmp_path, tiny_run())
    path = tmp_path / RECONSTRUCTION_NAME
    with np.load(path) as content:
        arrays = {name: content[name] for name in content.files}
    arrays["xyz"] = np.array([object(), object()], dtype=object)
    np.savez(path, **arrays)
    with pytest.raises(SourceError, match="damaged"):
        read_run(tmp_path)
    with zipfile.ZipFile(path) as archive:
        assert "xyz.npy" in archive.namelist()


def test_files_of_other_names_are_no_images_of_the_run(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("000003.jpg", "1\u00b20.jpg", "mine.jpg"):
        (tmp_path / "images" / name).write_bytes(b"x")
    assert list(read_image_paths(tmp_path)) == [3]
