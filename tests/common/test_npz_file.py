import os

import numpy as np
import pytest

from semcast.common.npz_file import HEADER, read_npz, write_npz

ARRAYS = {"xyz": np.arange(12.0).reshape(4, 3), "ids": np.zeros(0, np.int64)}


@pytest.mark.parametrize("compressed", [False, True])
def test_header_and_arrays_are_read_as_they_were_written(tmp_path, compressed):
    path = tmp_path / "new" / "file.npz"
    write_npz(path, {"format": 1, "name": "ä"}, ARRAYS, compressed=compressed, durable=True)
    header, arrays = read_npz(path, 10_000)
    assert header == {"format": 1, "name": "ä"}
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays[name], array)
    assert os.listdir(path.parent) == ["file.npz"]


def test_objects_are_neither_written_nor_read(tmp_path):
    path = tmp_path / "file.npz"
    with pytest.raises(ValueError, match="Object arrays"):
        write_npz(path, {}, {"x": np.array([object()])}, compressed=False)
    assert not path.exists()
    header = np.frombuffer(b"{}", np.uint8)
    np.savez(path, **{HEADER: header, "x": np.array([object()])})
    with pytest.raises(ValueError, match="^is damaged: "):
        read_npz(path, 10_000)


def test_what_unpacks_to_too_much_is_refused(tmp_path):
    path = tmp_path / "file.npz"
    write_npz(path, {}, {"x": np.zeros(100_000)}, compressed=True)
    assert path.stat().st_size < 10_000
    with pytest.raises(ValueError, match=r"^must unpack to at most 10000 bytes, got 800\d\d\d$"):
        read_npz(path, 10_000)


@pytest.mark.parametrize("header", [b"[1]", b"1", b"{", None])
def test_a_file_without_a_header_is_damaged(tmp_path, header):
    path = tmp_path / "file.npz"
    np.savez(path, **({} if header is None else {HEADER: np.frombuffer(header, np.uint8)}))
    with pytest.raises(ValueError, match="^is damaged: "):
        read_npz(path, 10_000)
    with pytest.raises(FileNotFoundError):
        read_npz(tmp_path / "none.npz", 10_000)
