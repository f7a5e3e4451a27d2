"""The source is read on a thread of its own, and what it leaves out is counted."""

import shutil

import numpy as np
import pytest

from semcast.agent.capture import Capture
from semcast.agent.source import SourceFrame, open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.errors import SourceError
from semcast.common.metrics import Metrics


def test_images_that_can_not_be_read_are_counted_wherever_they_are(recording, tmp_path):
    folder = tmp_path / "damaged"
    shutil.copytree(recording, folder)
    for k in (4, 5, 11):
        (folder / "images" / f"{k:06d}.png").write_bytes(b"broken")
    metrics = Metrics("agent")
    source = open_source(SourceSettings(source=str(folder), pace="rate", rate_hz=1000.0))
    capture = Capture(source, "all", metrics)
    taken = []
    while not capture.ended:
        frame = capture.get(1.0)
        taken += [] if frame is None else [frame.frame_id]
    capture.close()
    assert taken == [0, 1, 2, 3, 6, 7, 8, 9, 10]
    assert metrics.drops == {"unreadable": 3}
    assert metrics.closing_line("captured") == "9 frames captured; dropped: 3 unreadable"


class Counting:
    """Nine frames of grey k, which notes the ones that were undistorted."""

    num_unreadable = 0

    def __init__(self):
        self.rectified = []

    def _rectify(self, stored):
        self.rectified.append(int(stored[0, 0, 0]))
        return stored[::2, ::2]

    def frames(self, stop):
        for k in range(9):
            yield SourceFrame(k, k, k, np.full((4, 4, 3), k, np.uint8), k == 8, self._rectify)

    def close(self):
        pass


def test_frames_that_are_not_sent_are_not_undistorted():
    source, metrics = Counting(), Metrics("agent")
    capture = Capture(source, "all", metrics, lambda frame: frame.frame_id % 3 == 0)
    taken = []
    while not capture.ended:
        frame = capture.get(1.0)
        taken += [] if frame is None else [frame]
    capture.close()
    assert source.rectified == [0, 3, 6, 8] == [frame.frame_id for frame in taken]
    assert all(frame.image.shape == (2, 2, 3) and (frame.image == frame.frame_id).all() for frame in taken)
    assert source.rectified == [0, 3, 6, 8]  # once each
    assert metrics.drops == {"thinned": 5}


class Breaking(Counting):
    """Gives one frame, leaves two out and fails."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def frames(self, stop):
        yield SourceFrame(0, 0, 0, np.zeros((4, 4, 3), np.uint8), False)
        self.num_unreadable = 2
        raise self.error


@pytest.mark.parametrize(
    ("error", "told"),
    [(SourceError("the plug is out"), "the plug is out"), (KeyError(7), "the source failed: 7")],
)
def test_what_a_source_failed_with_is_kept_for_the_end_of_what_it_gave(error, told):
    metrics = Metrics("agent")
    capture = Capture(Breaking(error), "all", metrics)
    taken = []
    while not capture.ended:
        frame = capture.get(1.0)
        taken += [] if frame is None else [frame.frame_id]
    capture.close()
    assert taken == [0]
    assert metrics.drops == {"unreadable": 2}, "also those after the last frame"
    with pytest.raises(SourceError) as failed:
        capture.raise_failure()
    assert str(failed.value) == told
