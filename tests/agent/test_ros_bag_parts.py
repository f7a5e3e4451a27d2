"""Bags of ROS 1 that were split: the parts in a folder are one, other bags are not."""

import numpy as np
import pytest
from bags import SECOND, BagMaker

from semcast.agent.unpack import UnpackSettings, unpack
from semcast.common.errors import SourceError
from semcast.common.sequence import open_sequence

START = 1_700_000_000 * SECOND + 1
STEP = SECOND // 10


def picture(k):
    return np.full((48, 64, 3), 10 * k, np.uint8)


def test_the_parts_of_a_bag_of_ros_1_are_one_in_a_folder_of_their_own(tmp_path):
    parts = tmp_path / "parts"
    parts.mkdir()
    for name, numbers in (("drive_1", (3, 4)), ("drive_0", (0, 1, 2))):
        bag = BagMaker("bag")
        for k in numbers:
            bag.image("/cam/image_raw", picture(k), "bgr8", START + k * STEP)
        bag.write(parts, name)
    assert unpack(UnpackSettings(bag=parts, out=tmp_path / "out")).num_images == 5
    assert open_sequence(tmp_path / "out").times_ns.tolist() == [START + k * STEP for k in range(5)]
    assert unpack(UnpackSettings(bag=parts / "drive_0.bag", out=tmp_path / "part")).num_images == 3
    (parts / "notes.txt").write_text("mine")
    with pytest.raises(SourceError, match="parts is no ROS bag"):
        unpack(UnpackSettings(bag=parts, out=tmp_path / "other"))


@pytest.mark.parametrize(
    ("names", "begin_s", "told"),
    [
        (("yard", "street"), (0, 1), "street.bag has no number"),
        (("2026-01-05-10-00-00", "2026-01-05-11-00-00"), (0, 3600), "00-00.bag has no number"),
        (("yard_0", "street_1"), (0, 1), "street_1.bag and yard_0.bag differ by more than a number"),
        (("drive_2026-01-05-10-00-00_0", "drive_2026-01-06-10-00-00_0"), (0, 1), "have the same number"),
        (("drive_0", "drive_1"), (0, 3600), "drive_1.bag begins 3599.8 s after the end of drive_0.bag"),
        (("drive_0", "drive_1"), (3600, 0), "drive_1.bag begins 3600.2 s before the end of drive_0.bag"),
    ],
)
def test_bags_that_are_not_the_parts_of_one_are_refused(names, begin_s, told, tmp_path):
    folder = tmp_path / "bags"
    folder.mkdir()
    for name, start_s in zip(names, begin_s, strict=True):
        bag = BagMaker("bag")
        for k in range(3):
            bag.image("/cam/image_raw", picture(k), "bgr8", START + start_s * SECOND + k * STEP)
        bag.write(folder, name)
    with pytest.raises(SourceError, match=f"bags are not the parts of one: .*{told}; name one of them"):
        unpack(UnpackSettings(bag=folder, out=tmp_path / "out"))
    assert unpack(UnpackSettings(bag=folder / f"{names[0]}.bag", out=tmp_path / "one")).num_images == 3


def test_parts_are_named_with_the_time_at_which_each_begins_and_may_be_empty(tmp_path):
    # Part 10 sorts before part 2 as text. The last one was begun when the recording was stopped.
    for number, numbers in ((1, (0, 1)), (2, (2, 3)), (10, (4,)), (11, ())):
        bag = BagMaker("bag")
        for k in numbers:
            bag.image("/cam/image_raw", picture(k), "bgr8", START + k * 5 * SECOND)
        (tmp_path / "bags").mkdir(exist_ok=True)
        bag.write(tmp_path / "bags", f"2026-01-05-10-00-{number:02d}_{number}")
    assert unpack(UnpackSettings(bag=tmp_path / "bags", out=tmp_path / "out")).num_images == 5
