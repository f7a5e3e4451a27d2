"""A disk without room keeps the file waiting, or ends it, and not the run; who watches that is told."""

from types import SimpleNamespace

import numpy as np
import pytest
from full_disk import room_for
from waiting import until

from semcast.common.camera import Intrinsics
from semcast.server.dense.cloud import DensePatch
from semcast.server.view.frame_view import FrameView
from semcast.server.view.settings import ViewSettings

pytest.importorskip("rerun")

from semcast.server.view.feed import ViewerFeed
from semcast.server.view.file_stream import FileStream
from semcast.server.view.rerun_viewer import Delivery

CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)
ROOM_BYTES = 50_000


@pytest.fixture
def full_disk(tmp_path):
    """A file of which the system takes no more than ``ROOM_BYTES``."""
    with room_for(ROOM_BYTES):
        yield tmp_path / "run.rrd"


def frame(k):
    image = np.random.default_rng(k).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    none = np.zeros((0, 2), np.float32)
    return FrameView(k, k, np.eye(4), "tracking", {}, image, None, none, np.zeros(0, bool))


def test_a_full_disk_is_told_once_and_the_run_goes_on(full_disk, caplog):
    told = []
    settings = ViewSettings(view="file", image_rate_hz=60)
    feed = ViewerFeed(settings, CAMERA, "full", file=full_disk, on_error=told.append)
    k = 0

    def is_told():
        nonlocal k
        feed.submit(frame(k))
        k += 1
        return told

    until(is_told, "it is told")
    feed.submit(frame(k))
    feed.close()
    assert told == [f"{full_disk} can't be written to its end (is there room on the disk?)"]
    assert caplog.messages == [f"{told[0]}, the run goes on without it"]
    assert not feed._pending
    assert full_disk.stat().st_size == ROOM_BYTES


def test_a_disk_that_is_full_in_the_last_second_is_told_too(full_disk):
    told = []
    feed = ViewerFeed(ViewSettings(view="file"), CAMERA, "full", file=full_disk, on_error=told.append)
    for k in range(20):
        xyz = np.random.default_rng(k).random((1000, 3), np.float32)
        grey = np.full((1000, 3), 9, np.uint8)
        feed.submit(None, patches=[DensePatch(k, xyz, grey, np.ones(1000, np.float32))])
    feed.close()
    assert len(told) == 1


@pytest.mark.parametrize("delivery", Delivery)
def test_a_file_whose_end_did_not_go_out_is_told(tmp_path, delivery):
    class Ended:
        """Rerun's stream, or one whose thread ended or took the question with it."""

        closed = held_went_out = False

        def write_held(self):
            self.held_went_out = True

        def flush(self, timeout_s):
            assert self.held_went_out, "asked before all was written"
            return delivery

        def close(self, deadline_s):
            self.closed = True

    stream, told = Ended(), []
    FileStream(stream, tmp_path / "run.rrd", lambda cursor: None, told.append).close()
    assert len(told) == (delivery is not Delivery.DONE)
    assert stream.closed


def test_the_file_leaves_the_end_of_a_disk_to_the_results(tmp_path, monkeypatch, caplog):
    class Stream:
        def __init__(self):
            self.written = []

        def write(self, changes):
            self.written.append(changes)

        def flush(self, timeout_s):
            return Delivery.DONE

    stream, told, rounds = Stream(), [], iter(range(100))
    file = FileStream(stream, tmp_path / "run.rrd", lambda cursor: next(rounds), told.append)
    monkeypatch.setattr("semcast.server.view.file_stream._FLUSH_INTERVAL_S", 0.0)
    for free, written in ((101e6, [0]), (99e6, [0, 1]), (98e6, [0, 1]), (101e6, [0, 1]), (101e6, [0, 1, 2])):
        monkeypatch.setattr("shutil.disk_usage", lambda path, free=free: SimpleNamespace(free=free))
        file.write()
        assert stream.written == written, "what waits is written when there is room again"
    why = "99 MB of the disk are free, of which 100 are kept for results"
    assert told == [f"{tmp_path / 'run.rrd'} is not written any further: {why}"]
    assert [message.partition(";")[0] for message in caplog.messages] == [
        told[0],
        f"{tmp_path / 'run.rrd'} is written again, with what waited",
    ]


def test_a_file_that_is_whole_is_no_error(tmp_path):
    told = []
    feed = ViewerFeed(
        ViewSettings(view="file"), CAMERA, "whole", file=tmp_path / "run.rrd", on_error=told.append
    )
    feed.submit(frame(0))
    feed.close()
    assert not told
