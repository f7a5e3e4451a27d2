"""Parts of a map that never met are told apart, and one of them can be taken alone."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from semcast import SourceError
from semcast.cli import main
from semcast.commands.demo import summary_table
from semcast.common.run_folder import VIEWER_NAME, read_run
from semcast.server.export import formats
from semcast.server.export.formats import export_run
from semcast.server.export.parts import after_gaps, count_parts, parts_line, select_part
from semcast.server.mapping.world_map import Keyframe, WorldMap


def world_of_two_parts():
    """Part 0 with keyframe 0 and frame 1, part 1 with keyframe 5 and frame 6; two landmarks each."""
    world = WorldMap()
    for submap, frame_id in ((0, 0), (1, 5)):
        ids = 10 * submap + np.arange(2)
        world.add_keyframe(
            Keyframe(
                frame_id=frame_id,
                t_source_ns=frame_id,
                T_world_cam=np.eye(4),
                submap=submap,
                ids=ids,
                xy=np.zeros((2, 2)),
                confidence=np.ones(2),
            )
        )
        world.add_landmarks(ids, np.ones((2, 3)), np.zeros((2, 3), np.uint8), np.ones(2), submap, frame_id)
        world.add_frame(frame_id + 1, frame_id, np.eye(4))
    return world


def two_parts(data):
    """The run, with its last four of nine frames and the second half of its landmarks in part 2."""
    half = len(data.landmark_ids) // 2
    return replace(
        data,
        frame_submap=np.where(np.arange(len(data.frame_ids)) < 5, 0, 2),
        landmark_submap=np.where(np.arange(len(data.landmark_ids)) < half, 0, 2),
    )


def test_a_frame_is_in_the_part_of_its_keyframe_and_goes_along_when_parts_meet():
    world = world_of_two_parts()
    assert world.part_of_frames() == {0: 0, 1: 0, 5: 1, 6: 1}
    assert world.landmarks.submap.tolist() == [0, 0, 1, 1]
    world.transform_submap(1, 0, 2.0, np.eye(4))
    assert world.part_of_frames() == {0: 0, 1: 0, 5: 0, 6: 0}
    assert world.landmarks.submap.tolist() == [0, 0, 0, 0]
    assert WorldMap().part_of_frames() == {}


def test_parts_are_counted_by_number_and_only_several_are_worth_a_line():
    parts = count_parts([3, 0, 3, 3])
    assert parts == [{"submap": 0, "num_posed": 1}, {"submap": 3, "num_posed": 3}]
    assert parts_line(parts) == (
        "2 (part 0: 1 frames, part 3: 3 frames); the place and scale of all but the first are guessed"
    )
    assert parts_line(count_parts([0, 0])) is None
    assert parts_line([]) is None


def test_one_part_has_its_own_frames_landmarks_and_observations_only(arc_run):
    data = two_parts(arc_run())
    assert select_part(data, "all") is data
    later = select_part(data, "2")
    np.testing.assert_array_equal(later.frame_ids, data.frame_ids[5:])
    np.testing.assert_array_equal(later.T_world_cam, data.T_world_cam[5:])
    np.testing.assert_array_equal(later.landmark_ids, data.landmark_ids[30:])
    assert set(later.keyframe_ids) == set(data.keyframe_ids) & set(data.frame_ids[5:])
    between = [
        (frame_id > data.frame_ids[4]) != (landmark_id >= 130)
        for frame_id, landmark_id in zip(data.observed_keyframe_ids, data.observed_landmark_ids, strict=True)
    ]
    num_both = len(select_part(data, "0").observed_xy) + len(later.observed_xy)
    assert 0 < num_both == len(data.observed_xy) - sum(between)


def test_the_largest_part_is_that_of_most_posed_frames(arc_run):
    data = two_parts(arc_run())
    assert set(select_part(data, "largest").frame_submap) == {0}
    swapped = replace(data, frame_submap=2 - data.frame_submap)
    assert set(select_part(swapped, "largest").frame_submap) == {2}


def test_a_part_that_is_not_there_is_refused_with_those_that_are(arc_run):
    with pytest.raises(SourceError, match=r"part must be one of 0, 2, got 1"):
        select_part(two_parts(arc_run()), "1")
    with pytest.raises(ValueError, match="largest or all, got 'first'"):
        select_part(arc_run(), "first")


@pytest.mark.parametrize("format_name", ["tum", "kitti", "ply", "colmap", "nerfstudio"])
def test_several_parts_in_one_model_are_told_in_one_line(
    tmp_path, arc_run, write_arc_run, caplog, format_name
):
    write_arc_run(tmp_path / "two", two_parts(arc_run()))
    export_run(tmp_path / "two", format_name, tmp_path / "a")
    assert [record.getMessage() for record in caplog.records] == [
        "parts of the map: 2 (part 0: 5 frames, part 2: 4 frames); the place and scale of all but the first "
        "are guessed; --part largest writes one that fits together"
    ]
    caplog.clear()
    export_run(tmp_path / "two", format_name, tmp_path / "b", "2")
    write_arc_run(tmp_path / "one", arc_run())
    export_run(tmp_path / "one", format_name, tmp_path / "c")
    assert not caplog.records


def test_the_command_writes_one_part(tmp_path, arc_run, write_arc_run, capsys, monkeypatch):
    data = two_parts(arc_run())
    write_arc_run(tmp_path / "run", data)
    words = ["export", str(tmp_path / "run"), "--format", "colmap", "--out", str(tmp_path / "out")]
    reads = []
    monkeypatch.setattr(formats, "read_run", lambda folder: reads.append(folder) or read_run(folder))
    assert main([*words, "--part", "2"]) == 0
    assert reads == [tmp_path / "run"]
    assert capsys.readouterr().err.startswith("4 posed frames, 2 keyframes, 30 landmarks")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    ids = sorted(int(image.name.removesuffix(".jpg")) for image in model.images.values())
    assert ids == [k for k in data.keyframe_ids.tolist() if k > data.frame_ids[4]]
    assert len(list((tmp_path / "out" / "images").iterdir())) == len(ids)
    assert main([*words, "--part", "7"]) == 1
    assert "part must be one of 0, 2, got 7" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--part", "some"])


def test_one_part_is_not_the_servers_recording_of_all(tmp_path, arc_run, write_arc_run):
    write_arc_run(tmp_path / "run", two_parts(arc_run()))
    (tmp_path / "run" / VIEWER_NAME).write_bytes(b"as the server wrote it")
    export_run(tmp_path / "run", "rrd", tmp_path / "all.rrd")
    export_run(tmp_path / "run", "rrd", tmp_path / "one.rrd", "largest")
    assert (tmp_path / "all.rrd").read_bytes() == b"as the server wrote it"
    assert (tmp_path / "one.rrd").read_bytes() != b"as the server wrote it"


def test_the_table_of_a_run_names_its_parts_only_where_there_are_several():
    for parts, told in (([0, 0, 3], ["2 (part 0: 2 frames, part 3: 1 frames)"]), ([0, 0], [])):
        cells = [
            text for column in summary_table({"parts": count_parts(parts)}).columns for text in column.cells
        ]
        assert [text.split(";")[0] for text in cells if "(part 0" in text] == told


def test_a_line_is_broken_where_frames_were_tracked_that_have_no_pose_in_the_end():
    posed = {1, 2, 3, 6, 7, 8, 9, 11, 13}  # 1 and 8 later than when they were tracked
    assert after_gaps(posed, [0, 1, 4, 5, 8, 10, 15]) == {6, 11}
    assert after_gaps([], [1, 2]) == after_gaps(posed, []) == frozenset()
