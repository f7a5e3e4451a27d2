"""How many cores a process may use."""

import os

import pytest

from semcast.common.cores import usable_cores


def test_all_cores_where_nothing_limits_them(tmp_path):
    own = len(os.sched_getaffinity(0))
    assert usable_cores(tmp_path) == own
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert usable_cores(tmp_path) == own


@pytest.mark.parametrize(
    ("limit", "cores"), [("100000 100000\n", 1), ("50000 100000\n", 1), ("99900000 100000\n", 999)]
)
def test_a_container_has_no_more_than_its_time(tmp_path, monkeypatch, limit, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: range(2000))
    (tmp_path / "cpu.max").write_text(limit)
    assert usable_cores(tmp_path) == cores


def test_control_groups_of_version_1_and_damaged_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: range(8))
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu/cpu.cfs_period_us").write_text("100000\n")
    (tmp_path / "cpu/cpu.cfs_quota_us").write_text("-1\n")
    assert usable_cores(tmp_path) == 8, "-1 is no limit"
    (tmp_path / "cpu/cpu.cfs_quota_us").write_text("350000\n")
    assert usable_cores(tmp_path) == 3
    (tmp_path / "cpu/cpu.cfs_period_us").write_text("0\n")
    assert usable_cores(tmp_path) == 8
