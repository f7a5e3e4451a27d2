import pytest
from bags import CONTAINERS, SECOND, BagMaker

from semcast.common.errors import SourceError
from semcast.common.recording_reader import RecordingReader
from semcast.common.recording_writer import RecordingWriter
from semcast.common.ros_bag_files import check_no_ros_bag, is_ros_bag
from semcast.common.sequence import open_sequence


def small_bag(container, folder):
    bag = BagMaker(container)
    bag.pose("/pose", "world", (0.0, 0.0, 0.0), SECOND)
    return bag.write(folder)


@pytest.mark.parametrize("container", CONTAINERS)
def test_bags_are_known_by_how_they_look(container, tmp_path):
    path = small_bag(container, tmp_path)
    assert is_ros_bag(path)
    assert container == "bag" or is_ros_bag(tmp_path / "drive"), "the folder that ROS 2 writes"


def test_a_recording_of_semcast_is_none_though_it_is_mcap(tmp_path):
    path = tmp_path / "stream.mcap"
    with path.open("wb") as file:
        RecordingWriter(file, {}).finish()
    assert not is_ros_bag(path)


def test_other_files_and_folders_are_none(tmp_path):
    (tmp_path / "metadata.yaml").write_text("name: photos\n")
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n\x01")
    assert not any(map(is_ros_bag, (tmp_path, tmp_path / "cut.mcap", tmp_path / "nothing")))


@pytest.mark.parametrize("read", [open_sequence, RecordingReader, check_no_ros_bag])
def test_who_reads_something_else_says_what_to_do(read, tmp_path):
    path = small_bag("mcap", tmp_path)
    with pytest.raises(SourceError, match=r"is a ROS bag: .* semcast unpack .*drive.mcap --out FOLDER"):
        read(path)
