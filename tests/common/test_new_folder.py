import os
import shutil
import signal
import threading

import pytest

from semcast.common.errors import SourceError
from semcast.common.new_folder import new_folder


def test_a_folder_that_was_filled_stays(tmp_path):
    with new_folder(tmp_path / "a" / "b") as folder:
        (folder / "file").write_text("x")
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["file"]


@pytest.mark.parametrize("what", [SourceError("damaged"), KeyboardInterrupt()])
@pytest.mark.parametrize("is_there", [True, False])
def test_a_folder_that_could_not_be_filled_is_as_it_was_for_the_next_try(tmp_path, what, is_there):
    if is_there:
        (tmp_path / "out").mkdir()

    def fill():
        with new_folder(tmp_path / "out") as folder:
            (folder / "images").mkdir()
            (folder / "images" / "0.png").write_text("x")
            (folder / "times.txt").write_text("0")
            raise what

    with pytest.raises(type(what)):
        fill()
    assert [path.name for path in tmp_path.rglob("*")] == (["out"] if is_there else [])
    with new_folder(tmp_path / "out") as folder:
        assert folder.is_dir()


def test_what_is_in_a_folder_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(SourceError, match="must be a new or an empty folder"), new_folder(tmp_path):
        pass
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_why_a_folder_can_not_be_written_is_said(tmp_path):
    def fill():
        with new_folder(tmp_path / "out"):
            raise OSError(28, "No space left on device")

    with pytest.raises(SourceError, match="can't write to .*out: No space left on device"):
        fill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_asked_to_end_leaves_nothing_behind(number, tmp_path):
    if (before := signal.getsignal(number)) is signal.SIG_IGN:
        pytest.skip("this process was told to ignore the signal, and so does what fills a folder")

    def fill():
        with new_folder(tmp_path / "out") as folder:
            (folder / "times.txt").write_text("0")
            os.kill(os.getpid(), number)
            threading.Event().wait(10)

    with pytest.raises(SystemExit) as ended:
        fill()
    assert ended.value.code == 128 + number
    assert not (tmp_path / "out").exists()
    assert signal.getsignal(number) == before


def test_what_a_killed_run_left_is_told_from_what_is_the_users(tmp_path):
    with new_folder(tmp_path / "out") as folder:
        shutil.copytree(folder, tmp_path / "killed")
    with pytest.raises(SourceError, match="killed has an unfinished sequence in it: delete it"):
        new_folder(tmp_path / "killed").__enter__()
