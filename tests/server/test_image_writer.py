import itertools
import threading
import types
from pathlib import Path

import cv2
import numpy as np
from waiting import until

from semcast.common.run_folder import read_image_paths
from semcast.server.image_writer import RETRY_S, ImageWriter


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
    monkeypatch.setattr("semcast.server.image_writer.MAX_PROVISIONAL", 3)
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


def test_images_leave_the_end_of_a_disk_to_the_results(tmp_path, monkeypatch, caplog):
    free = iter((101_000_000, 99_000_000, 101_000_000))
    monkeypatch.setattr("shutil.disk_usage", lambda path: types.SimpleNamespace(free=next(free)))
    with ImageWriter(tmp_path, lossless=True, clock_s=itertools.count(0.0, 10.0).__next__) as writer:
        for k in range(3):
            writer.put(k, picture(k))
    assert list(read_image_paths(tmp_path)) == [0, 2]
    assert "99 MB of the disk are free, of which 100 are kept for results" in caplog.text


def test_whatever_an_image_can_not_be_written_for_holds_nobody_up(tmp_path, monkeypatch, caplog):
    def broken(self, item):
        raise MemoryError

    monkeypatch.setattr(ImageWriter, "_write", broken)
    writer = ImageWriter(tmp_path, lossless=True, capacity=1)
    putting = threading.Thread(target=lambda: [writer.put(k, picture(0)) for k in range(6)], daemon=True)
    putting.start()
    putting.join(60)
    assert not putting.is_alive()
    writer.close()
    assert (writer.num_written, writer.num_dropped) == (0, 6)
    assert caplog.text.count("MemoryError; the run goes on without images") == 1


def test_a_disk_that_hangs_keeps_nobody_longer_than_the_deadline(tmp_path, monkeypatch, caplog):
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
    closing.join(60)
    assert not closing.is_alive()
    told = f"2 images are not in {tmp_path / 'images'}: the disk was too slow"
    assert told in caplog.text
    writer.put(3, picture(3))
    assert writer.num_dropped == 2, "after the end it is ignored"
    writer.close(0.0)
    assert caplog.text.count("images are not in") == 1
    may_go_on.set()


def test_images_are_kept_again_once_the_disk_has_room(tmp_path, monkeypatch, caplog):
    now_s, is_full, told = 0.0, True, []
    write = Path.write_bytes

    def write_if_room(path, data):
        if is_full:
            raise OSError(28, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", write_if_room)
    writer = ImageWriter(tmp_path, lossless=True, on_error=told.append, clock_s=lambda: now_s)

    def put(frame_id):
        before = writer.num_written + writer.num_dropped
        writer.put(frame_id, picture(1), provisional=frame_id == 4)
        until(lambda: writer.num_written + writer.num_dropped == before + 1)

    put(0)
    now_s = RETRY_S
    put(1)
    now_s += 1.0
    put(2)
    is_full = False
    put(3)
    assert writer.num_written == 0, "it is not tried with every image"
    now_s = 2.0 * RETRY_S
    put(4)
    put(5)
    writer.settle([4])
    writer.close()
    assert list(read_image_paths(tmp_path)) == [4, 5]
    assert (writer.num_written, writer.num_dropped) == (2, 4)
    assert len(told) == caplog.text.count("the run goes on without images") == 1
    assert "images is written again; 4 images were left out" in caplog.text
