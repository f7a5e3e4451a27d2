"""Rows survive a kill and a full disk."""

import json
from dataclasses import replace

import numpy as np
import pytest
from full_disk import room_for
from rows_of_runs import frame_row

from semcast.common.errors import SemcastError
from semcast.common.run_folder import FRAMES_NAME
from semcast.server import frame_rows
from semcast.server.frame_rows import FrameRow, FrameRows, read_rows
from semcast.server.mapping.state import DecodedFrame, FrameResult, TrackingState


def test_rows_are_on_disk_at_once_and_a_torn_last_line_is_left_out(tmp_path):
    record = FrameRows(tmp_path)
    record.add(frame_row(0))
    record.add(frame_row(1, posed=False, psnr_db=float("nan")))
    path = tmp_path / FRAMES_NAME
    assert [r.frame_id for r in read_rows(path)] == [0, 1]
    assert read_rows(path)[1].psnr_db is None
    path.write_text(path.read_text() + '{"frame_id": 2, "t_sou')
    assert [r.frame_id for r in read_rows(path)] == [0, 1]
    record.close()


def test_a_resumed_run_goes_on_behind_its_rows_and_a_new_run_does_not(tmp_path):
    for k, resume, expected in ((0, False, [0]), (1, True, [0, 1]), (1, True, [0, 1]), (1, False, [1])):
        record = FrameRows(tmp_path, resume=resume)
        record.add(frame_row(k))
        record.close()
        record.close()
        assert [r.frame_id for r in record.rows()] == expected


def test_damage_in_the_middle_is_an_error_with_its_line(tmp_path):
    (tmp_path / FRAMES_NAME).write_text('{"frame_id": 1}\n{"frame_id": 2}\n')
    with pytest.raises(SemcastError, match=r"frames.jsonl:1 "):
        read_rows(tmp_path / FRAMES_NAME)


def test_rows_tell_the_part_of_the_map_and_older_rows_count_as_the_first(tmp_path):
    record = FrameRows(tmp_path)
    record.add(frame_row(0, submap=2))
    record.close()
    path = tmp_path / FRAMES_NAME
    assert read_rows(path)[0].submap == 2
    older = json.loads(path.read_text())
    del older["submap"]
    path.write_text(json.dumps(older) + "\n")
    assert read_rows(path)[0].submap == 0


def test_without_a_folder_rows_stay_in_memory():
    record = FrameRows(None)
    record.add(frame_row(3))
    assert [r.frame_id for r in record.rows()] == [3]


def half_a_row_more(folder):
    return (folder / FRAMES_NAME).stat().st_size + 100


def ids_in(folder):
    return [r.frame_id for r in read_rows(folder / FRAMES_NAME)]


def test_rows_a_full_disk_did_not_take_are_written_when_it_has_room_again(tmp_path, caplog):
    now_s, told = 0.0, []
    record = FrameRows(tmp_path, on_error=told.append, clock=lambda: now_s)
    record.add(frame_row(0))
    with room_for(half_a_row_more(tmp_path)):
        for k in (1, 2, 3):
            record.add(frame_row(k))
            now_s += 2.0
    assert (tmp_path / FRAMES_NAME).read_bytes()[-1:] != b"\n", "a part of row 1 is there"
    assert [r.frame_id for r in record.rows()] == [0, 1, 2, 3]
    assert told == [f"{tmp_path / FRAMES_NAME} can't be written: [Errno 27] File too large"]
    assert caplog.text.count("File too large") == 1
    record.add(frame_row(4))
    assert ids_in(tmp_path) == [0, 1, 2, 3, 4]
    assert "is written again, with the rows that waited" in caplog.text
    record.add(frame_row(5))
    record.close()
    assert ids_in(tmp_path) == [r.frame_id for r in record.rows()] == [0, 1, 2, 3, 4, 5]


def test_rows_that_wait_at_the_end_are_written_then(tmp_path):
    record = FrameRows(tmp_path)
    with room_for(half_a_row_more(tmp_path)):
        for k in range(3):
            record.add(frame_row(k))
    record.finish()
    record.close()
    assert ids_in(tmp_path) == [0, 1, 2]


def test_rows_that_can_not_be_written_at_the_end_are_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(frame_rows, "MAX_ROWS_IN_MEMORY", 2)
    record = FrameRows(tmp_path)
    with room_for(half_a_row_more(tmp_path)):
        for k in range(3):
            record.add(frame_row(k))
        with pytest.raises(OSError, match="File too large"):
            record.finish()
    with pytest.raises(OSError, match="1 rows are lost"):
        record.finish()
    record.close()
    assert ids_in(tmp_path) == [1, 2]


def test_a_damaged_line_does_not_keep_a_run_from_going_on(tmp_path, caplog):
    record = FrameRows(tmp_path)
    for k in range(5):
        record.add(frame_row(k))
    record.close()
    path = tmp_path / FRAMES_NAME
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([lines[0], b"\0" * 40 + b"\n", b"[]\n", *lines[3:], b'{"frame_id": 5, "t_sou']))
    record = FrameRows(tmp_path, resume=True)
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING"] == [
        f"{path}: 2 lines are no frame rows and are left out: {path}:2 is not a frame row: "
        "Expecting value: line 1 column 1 (char 0)"
    ]
    record.add(frame_row(5))
    record.close()
    assert ids_in(tmp_path) == [0, 3, 4, 5]


def test_the_row_of_a_tracked_frame_is_what_was_received_and_what_came_of_it():
    none = np.zeros((0, 2), np.float32)
    frame = DecodedFrame(
        4, 400, np.zeros((2, 2, 3), np.uint8), np.array([[0.2, 0.4], [0.9, 0.9]], np.float32)
    )
    lost = FrameResult(
        4, 400, TrackingState.LOST, None, 30, 8, None, None, False, 2, 1, none, np.zeros(0, bool)
    )
    link = {"snr_set_db": 3.0, "snr_estimated_db": 2.5, "psnr_db": None, "age_ms": 50.0}
    made = FrameRow.of(frame, lost, **link)
    assert (made.frame_id, made.t_source_ns, made.state, made.posed) == (4, 400, "lost", False)
    assert (made.num_tracked, made.num_inliers, made.map_epoch, made.submap) == (30, 8, 2, 1)
    assert made.confidence_mean == pytest.approx(0.6)
    assert (made.snr_set_db, made.age_ms) == (3.0, 50.0)
    assert FrameRow.of(frame, replace(lost, T_world_cam=np.eye(4)), **link).posed
    assert FrameRow.of(replace(frame, confidence=None), lost, **link).confidence_mean is None
