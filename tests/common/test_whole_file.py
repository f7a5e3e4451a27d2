import os
import threading

import pytest

from semcast.common.errors import ConfigError
from semcast.common.whole_file import check_writable, whole_file, write_whole


@pytest.mark.parametrize("durable", [False, True])
def test_the_new_content_is_there_when_the_block_ends(tmp_path, durable):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with whole_file(path, durable=durable) as file:
        file.write(b"new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_failure_leaves_the_old_content_and_nothing_else(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def interrupted():
        with whole_file(path) as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_a_link_keeps_its_place_and_its_file_is_written(tmp_path):
    shared = tmp_path / "shared" / "a.txt"
    shared.parent.mkdir()
    shared.write_text("old")
    link = tmp_path / "a.txt"
    link.symlink_to("shared/a.txt")
    check_writable(link, "json")
    write_whole(link, "new")
    assert link.is_symlink()
    assert shared.read_text() == "new"
    assert [p.name for p in shared.parent.iterdir()] == ["a.txt"]


def test_a_file_without_a_folder_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError), whole_file(tmp_path / "no" / "a"):
        pass


def test_a_file_where_a_folder_would_have_to_be_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="json can't be written to .*/file/a: .*/file is a file, not"):
        check_writable(tmp_path / "file" / "a", "json")


def test_a_pipe_is_written_as_it_is_and_keeps_its_place(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()), name="reader")
    reader.start()
    check_writable(pipe, "json")
    write_whole(pipe, "a name: Bürö\n")
    reader.join(10.0)
    assert read == ["a name: Bürö\n".encode()]
    assert pipe.is_fifo()
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]
