"""The source is read on a thread of its own, and what it leaves out is counted."""

import shutil

from semcast.agent.capture import Capture
from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
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
