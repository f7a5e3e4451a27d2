import dataclasses
import threading
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast import SourceError
from semcast.common.camera import Intrinsics
from semcast.common.run_folder import (
    RECONSTRUCTION_NAME,
    ImageWriter,
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


def picture(k):
    return np.full((16, 24, 3), (200, 40 * k, 20), dtype=np.uint8)


def test_images_are_written_by_frame_id(tmp_path):
    with ImageWriter(tmp_path, lossless=True, capacity=1) as writer:
        for k in range(3):
            writer.put(10 * k, picture(k))
    assert writer.num_written == 3
    paths = read_image_paths(tmp_path)
    assert list(paths) == [0, 10, 20]
    rgb = cv2.cvtColor(cv2.imread(str(paths[20])), cv2.COLOR_BGR2RGB)
    assert rgb.shape == (16, 24, 3)
    np.testing.assert_allclose(rgb.reshape(-1, 3).mean(axis=0), (200, 80, 20), atol=3)


def test_a_writer_that_goes_on_keeps_what_is_there(tmp_path):
    for first in (0, 5):
        with ImageWriter(tmp_path, lossless=True) as writer:
            writer.put(first, picture(1))
    assert list(read_image_paths(tmp_path)) == [0, 5]


def test_files_of_other_names_are_no_images_of_the_run(tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("000003.jpg", "1\u00b20.jpg", "mine.jpg"):
        (tmp_path / "images" / name).write_bytes(b"x")
    assert list(read_image_paths(tmp_path)) == [3]


def test_provisional_images_stay_when_they_are_settled_for(tmp_path):
    with ImageWriter(tmp_path, lossless=True) as writer:
        for k in range(5):
            writer.put(k, picture(k), provisional=True)
        writer.put(5, picture(5))
        writer.settle([0, 3])
        writer.put(6, picture(6), provisional=True)
    assert list(read_image_paths(tmp_path)) == [0, 3, 5]


def test_images_that_can_not_be_written_are_told_once(tmp_path):
    told = []
    with ImageWriter(tmp_path, lossless=True, on_error=told.append) as writer:
        (tmp_path / "images" / "000000.jpg").mkdir()
        for k in range(3):
            writer.put(k, picture(k))
    assert len(told) == 1
    assert told[0].startswith(f"{tmp_path / 'images'} can't be written: ")
    assert writer.num_dropped == 3


def test_only_the_newest_provisional_images_wait(tmp_path, monkeypatch):
    monkeypatch.setattr("semcast.common.run_folder.MAX_PROVISIONAL", 3)
    with ImageWriter(tmp_path, lossless=True) as writer:
        for k in range(6):
            writer.put(k, picture(k), provisional=True)
        writer.settle(range(6))
    assert list(read_image_paths(tmp_path)) == [3, 4, 5]


def test_settling_never_waits_for_the_disk(tmp_path, monkeypatch):
    may_write = threading.Event()
    write = ImageWriter._write

    def slow(self, item):
        may_write.wait(30)
        write(self, item)

    monkeypatch.setattr(ImageWriter, "_write", slow)
    with ImageWriter(tmp_path, lossless=False, capacity=2) as writer:
        for k in range(8):
            writer.put(k, picture(k), provisional=True)
        writer.settle(range(8))
        assert not may_write.is_set()
        may_write.set()
    assert len(read_image_paths(tmp_path)) == writer.num_written >= 2
    assert writer.num_written + writer.num_dropped == 8


def test_a_folder_that_vanishes_is_counted_and_does_not_raise(tmp_path):
    writer = ImageWriter(tmp_path / "run", lossless=True)
    (tmp_path / "run" / "images").rmdir()
    for k in range(3):
        writer.put(k, np.zeros((8, 8, 3), dtype=np.uint8))
    writer.close()
    writer.close()
    assert (writer.num_written, writer.num_dropped) == (0, 3)


def test_an_image_that_finds_no_room_leaves_no_part_of_itself(tmp_path, monkeypatch):
    write = Path.write_bytes

    def full(path, data):
        if path.stem.endswith("1"):
            write(path, data[: len(data) // 2])
            raise OSError(28, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with ImageWriter(tmp_path, lossless=True) as writer:
        for k in range(3):
            writer.put(k, picture(k))
    assert list(read_image_paths(tmp_path)) == [0]
    assert (writer.num_written, writer.num_dropped) == (1, 2)


def test_whatever_an_image_can_not_be_written_for_holds_nobody_up(tmp_path, monkeypatch, caplog):
    def broken(self, item):
        raise MemoryError

    monkeypatch.setattr(ImageWriter, "_write", broken)
    writer = ImageWriter(tmp_path, lossless=True, capacity=1)
    putting = threading.Thread(target=lambda: [writer.put(k, picture(0)) for k in range(6)], daemon=True)
    putting.start()
    putting.join(10)
    assert not putting.is_alive()
    writer.close()
    assert (writer.num_written, writer.num_dropped) == (0, 6)
    assert caplog.text.count("MemoryError; the run goes on without images") == 1


def test_a_disk_that_hangs_keeps_nobody_longer_than_the_deadline(tmp_path, monkeypatch):
    writing, may_go_on = threading.Event(), threading.Event()

    def hanging(self, item):
        writing.set()
        may_go_on.wait(30)

    monkeypatch.setattr(ImageWriter, "_write", hanging)
    writer = ImageWriter(tmp_path, lossless=False, capacity=1)
    writer.put(0, picture(0))
    assert writing.wait(10)
    writer.put(1, picture(1))
    writer.put(2, picture(2))
    closing = threading.Thread(target=lambda: writer.close(0.05), daemon=True)
    closing.start()
    closing.join(10)
    assert not closing.is_alive()
    assert writer.num_dropped == 2
    writer.put(3, picture(3))
    assert writer.num_dropped == 2, "after the end it is ignored"
    may_go_on.set()
