"""What is there already is not written over."""

from semcast.common.former_file import keep_former


def test_former_files_get_the_next_free_name(tmp_path):
    file = tmp_path / "run.rrd"
    assert keep_former(file) is None
    for n, text in enumerate(("one", "two"), start=1):
        file.write_text(text)
        assert keep_former(file) == tmp_path / f"run-{n}.rrd"
    assert (tmp_path / "run-1.rrd").read_text() == "one"
    assert (tmp_path / "run-2.rrd").read_text() == "two"
    assert not file.exists()


def test_an_empty_file_is_nothing_to_keep(tmp_path):
    (tmp_path / "run.mcap").touch()
    assert keep_former(tmp_path / "run.mcap") is None
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
