import os

import numpy as np
import pytest

from semcast.channel.trace import (
    SNR_RANGE_DB,
    ConstantTrace,
    RandomWalkTrace,
    TableTrace,
    ramp,
    read_trace_csv,
)
from semcast.common.errors import ConfigError


def test_a_ramp_is_linear_and_then_stays():
    trace = ramp(10.0, 2.0, 4.0)
    assert [trace.snr_db(t) for t in (-1, 0, 1, 3, 4, 99)] == [10, 10, 8, 4, 2, 2]


def test_a_constant_is_constant():
    assert {ConstantTrace(7.5).snr_db(t) for t in (0, 1, 1e6)} == {7.5}


def test_a_walk_depends_on_the_seed_and_not_on_when_it_is_asked():
    times = np.linspace(0, 40, 83)
    forward = [RandomWalkTrace(8.0, 1.0, 3).snr_db(t) for t in times]
    walk = RandomWalkTrace(8.0, 1.0, 3)
    backward = [walk.snr_db(t) for t in times[::-1]][::-1]
    assert forward == backward
    assert forward != [RandomWalkTrace(8.0, 1.0, 4).snr_db(t) for t in times]
    assert forward[0] == 8.0


def test_a_walk_steps_by_its_deviation_and_stays_in_range():
    walk = RandomWalkTrace(10.0, 0.5, 1)
    values = np.array([walk.snr_db(0.5 * k) for k in range(4000)])
    assert np.std(np.diff(values)) == pytest.approx(0.5, rel=0.06)
    assert walk.snr_db(1.125) == pytest.approx(0.75 * values[2] + 0.25 * values[3])
    assert np.abs(np.diff(values)).max() < 5 * 0.5
    # Thrown back at either end and not held there, a walk is everywhere alike often.
    fast = RandomWalkTrace(5.0, 6.0, 1)
    values = np.array([fast.snr_db(0.5 * k) for k in range(4000)])
    assert not np.isin(values, SNR_RANGE_DB).any()
    np.testing.assert_allclose(np.histogram(values, 3, SNR_RANGE_DB)[0] / 4000, 1 / 3, atol=0.06)
    wild = RandomWalkTrace(0.0, 10.0, 1)
    values = np.array([wild.snr_db(0.5 * k) for k in range(500)])
    assert values.min() >= SNR_RANGE_DB[0]
    assert values.max() <= SNR_RANGE_DB[1]
    assert np.isfinite(wild.snr_db(1e9))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_file_is_read_and_interpolated(tmp_path, encoding):
    path = tmp_path / "trace.csv"
    path.write_text("t_s, snr_db, note\n0,10,start\n2.5,5,\n10,-1,end\n", encoding)
    trace = read_trace_csv(path)
    assert [trace.snr_db(t) for t in (0, 1.25, 2.5, 100)] == [10, 7.5, 5, -1]


def test_a_file_on_any_clock_begins_with_the_first_frame_and_may_tell_losses(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text("t_s,snr_db,slot_loss\n1700000000,10,0\n1700000002,4,0.5\n1700000003,4,1\n")
    trace = read_trace_csv(path)
    assert [trace.snr_db(t) for t in (0, 1, 2, 9)] == [10, 7, 4, 4]
    assert [trace.slot_loss(t) for t in (0, 1, 2, 9)] == [0, 0.25, 0.5, 1]
    path.write_text("t_s,snr_db\n0,10\n")
    assert read_trace_csv(str(path)).slot_loss(5.0) == 0


def test_comments_are_left_out_of_a_file_and_lines_keep_their_numbers(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text("# of 3 May\n#\nt_s,snr_db\n0,10\n # a tunnel\n2,4\n")
    trace = read_trace_csv(path)
    assert [trace.snr_db(t) for t in (0, 1, 2)] == [10, 7, 4]
    path.write_text(path.read_text() + "# out of it\n3,none\n")
    with pytest.raises(ConfigError, match="line 8: t_s and snr_db must be numbers, got '3', 'none'"):
        read_trace_csv(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,snr\n0,1\n", "must name the columns t_s,snr_db in its first line$"),
        ("", "must name the columns t_s,snr_db in its first line$"),
        ("t_s,snr_db\n", "holds no rows"),
        ("t_s,snr_db\n0,ten\n", r"line 2: t_s and snr_db must be numbers, got '0', 'ten'"),
        ("t_s,snr_db\n0\n", r"line 2: t_s and snr_db must be numbers, got '0', None"),
        ("t_s,snr_db\n0,1\n1,99\n", r"line 3: snr_db must be in \[-5, 30\], got 99"),
        ("t_s,snr_db\n0,nan\n", r"line 2: snr_db must be in \[-5, 30\], got nan"),
        ("t_s,snr_db,slot_loss\n0,1,1.1\n", r"line 2: slot_loss must be in \[0, 1\], got 1.1"),
        ("t_s,snr_db,slot_loss\n0,1,nan\n", r"line 2: slot_loss must be in \[0, 1\], got nan"),
        (
            "t_s,snr_db,slot_loss\n0,1,\n",
            r"line 2: t_s and snr_db and slot_loss must be numbers, got '0', '1', ''",
        ),
        ("t_s,snr_db\n1,1\n1,2\n", "line 3: t_s must increase, got 1"),
        ("t_s,snr_db\ninf,1\n", "line 2: t_s must increase, got inf"),
    ],
)
def test_a_bad_file_says_which_line_and_why(tmp_path, text, message):
    path = tmp_path / "trace.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_trace_csv(path)


def test_unreadable_files_are_config_errors(tmp_path):
    with pytest.raises(ConfigError, match="can't be read as an SNR trace"):
        read_trace_csv(tmp_path / "missing.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match="can't be read as an SNR trace"):
        read_trace_csv(tmp_path / "binary.csv")


def test_bad_tables_are_named():
    with pytest.raises(ValueError, match="as many times as values, got 2 and 1"):
        TableTrace([0, 1], [1])
    with pytest.raises(ValueError, match="times of a trace must increase"):
        TableTrace([0, 0], [1, 2])


def test_what_is_no_file_of_fair_size_is_not_read(tmp_path, monkeypatch):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path):
        with pytest.raises(ConfigError, match=f"{path} must be a file with an SNR trace"):
            read_trace_csv(path)
    long = tmp_path / "long.csv"
    with long.open("wb") as file:
        file.truncate((16 << 20) + 1)
    with pytest.raises(ConfigError, match="must be an SNR trace of at most 16 MB, got more"):
        read_trace_csv(long)
