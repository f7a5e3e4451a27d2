"""An output folder that is not empty."""

import errno
import subprocess
import sys

import pytest

from semcast.common.errors import ConfigError
from semcast.server.former_run import (
    check_not_foreign,
    discard,
    is_run,
    make_output_folder,
    output_folder,
    set_aside,
)

OURS = ("trajectory.tum", "map.ply", "summary.json", "settings.toml", "frames.jsonl", "run.rrd")
THEIRS = ("groundtruth.txt", "intrinsics.json", "run.mcap")


def fill(folder, names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)


def files_of(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_former_run_is_moved_as_a_whole_and_nothing_else(tmp_path):
    for n in (1, 2):
        fill(tmp_path, [*OURS, "images/000003.jpg"])
        fill(tmp_path, THEIRS)
        set_aside(tmp_path)
        assert not is_run(tmp_path)
        assert files_of(tmp_path / f"previous-{n}") == sorted([*OURS, "images/000003.jpg"])
    assert set(THEIRS) <= set(files_of(tmp_path))


@pytest.mark.parametrize("act", [set_aside, discard])
def test_a_folder_no_run_has_written_into_is_left_alone(tmp_path, act):
    # A recorded sequence, a cloud and pictures of somebody else.
    fill(tmp_path, ["images/000000.jpg", "images/000001.jpg", "map.ply", "frames.jsonl.txt", *THEIRS])
    before = files_of(tmp_path)
    act(tmp_path)
    act(tmp_path / "not_there")
    assert files_of(tmp_path) == before


def test_an_empty_row_file_alone_is_no_run(tmp_path):
    (tmp_path / "frames.jsonl").touch()
    set_aside(tmp_path)
    assert files_of(tmp_path) == ["frames.jsonl"]


def test_a_discarded_run_leaves_what_is_not_its_own(tmp_path):
    fill(tmp_path, [*OURS, *THEIRS, "images/000003.jpg", "images/mine.jpg"])
    discard(tmp_path)
    assert files_of(tmp_path) == sorted([*THEIRS, "images/mine.jpg"])


def test_names_of_ours_that_no_run_wrote_are_refused(tmp_path):
    check_not_foreign(tmp_path, "images")
    (tmp_path / "images").mkdir()
    check_not_foreign(tmp_path, "images")
    fill(tmp_path, ["images/000000.jpg"])
    with pytest.raises(ConfigError, match=r"out must not hold images that no run wrote"):
        check_not_foreign(tmp_path, "images")
    fill(tmp_path, OURS)
    check_not_foreign(tmp_path, "images")


def test_a_folder_for_outputs_has_no_images_of_others_and_is_one(tmp_path):
    make_output_folder(tmp_path / "new" / "run")
    assert (tmp_path / "new" / "run").is_dir()
    fill(tmp_path / "new" / "run", ["images/000000.jpg"])
    with pytest.raises(ConfigError, match=r"out must not hold images that no run wrote"):
        make_output_folder(tmp_path / "new" / "run")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file can't be made a folder for outputs"):
        make_output_folder(tmp_path / "file")


def test_a_folder_that_nothing_can_be_written_into_is_refused_at_once(tmp_path, monkeypatch):
    def may_not(**given):
        raise PermissionError(13, "Permission denied", given["dir"])

    monkeypatch.setattr("tempfile.TemporaryFile", may_not)
    with pytest.raises(ConfigError, match=r"can't be made a folder for outputs: .*Permission denied"):
        make_output_folder(tmp_path)


def test_a_folder_in_use_is_refused_until_the_run_ends(tmp_path):
    folder = tmp_path / "run"
    with output_folder(folder):
        with pytest.raises(
            ConfigError, match=f"out must not be in use, another run is writing into {folder}"
        ):
            output_folder(folder).__enter__()
        with output_folder(tmp_path / "other"), output_folder(None):
            pass
    with output_folder(folder):
        assert list(folder.iterdir()) == []


def test_a_killed_run_leaves_its_folder_free(tmp_path):
    program = (
        "import pathlib, sys, time\n"
        "from semcast.server.former_run import output_folder\n"
        "with output_folder(pathlib.Path(sys.argv[1])):\n"
        "    print('held', flush=True)\n"
        "    time.sleep(60)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", program, tmp_path], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "held\n"
        with pytest.raises(ConfigError, match="another run is writing into"):
            output_folder(tmp_path).__enter__()
    finally:
        child.kill()
        child.communicate()
    with output_folder(tmp_path):
        pass


def test_where_there_are_no_locks_a_folder_is_used_without(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("semcast.common.file_lock.fcntl.flock", refuse)
    with output_folder(tmp_path), output_folder(tmp_path):
        pass
    monkeypatch.setattr("semcast.common.file_lock.fcntl", None)
    with output_folder(tmp_path), output_folder(tmp_path):
        pass


def test_a_name_that_is_taken_is_passed_over(tmp_path):
    fill(tmp_path, OURS)
    (tmp_path / "previous-1").symlink_to(tmp_path / "nowhere")
    set_aside(tmp_path)
    assert is_run(tmp_path / "previous-2")


def test_what_can_not_be_moved_is_told_and_stays(tmp_path, caplog, monkeypatch):
    fill(tmp_path, [*OURS, "file"])
    monkeypatch.setattr(
        "semcast.server.former_run.free_folder", lambda folder: folder / "file" / "previous-1"
    )
    set_aside(tmp_path)
    assert "can't be set aside" in caplog.text
    assert files_of(tmp_path) == sorted([*OURS, "file"])
