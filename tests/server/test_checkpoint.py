"""Checkpoints are whole or refused."""

import os
from dataclasses import asdict

import numpy as np
import pytest
from waiting import until

from semcast.common.camera import Intrinsics
from semcast.common.errors import CheckpointError
from semcast.common.npz_file import write_npz
from semcast.server.checkpoint import (
    FORMAT,
    Checkpoint,
    CheckpointHeader,
    CheckpointWriter,
    load_checkpoint,
    mismatch,
    save_checkpoint,
)

CAMERA = Intrinsics(fx=50.0, fy=51.0, cx=31.5, cy=23.5, width=64, height=48)


def checkpoint(frame_id=7):
    header = CheckpointHeader(
        agent_id="cam0",
        agent_epoch=123456789,
        codec_digest="ab" * 8,
        camera=CAMERA,
        frame_id=frame_id,
        t_source_ns=700_000_000,
        map_epoch=2,
        drops={"superseded": 3, "missing": 1},
    )
    rng = np.random.default_rng(frame_id)
    arrays = {
        "xyz": rng.normal(size=(100, 3)),
        "ids": np.arange(100),
        "empty": np.zeros((0, 4, 4)),
        "state": np.array("tracking"),
    }
    return Checkpoint(header, arrays)


def test_a_round_trip_keeps_every_bit_and_type(tmp_path):
    path = tmp_path / "deep" / "map.npz"
    saved = checkpoint()
    save_checkpoint(path, saved)
    loaded = load_checkpoint(path)
    assert loaded.header == saved.header
    assert set(loaded.arrays) == set(saved.arrays)
    for name, array in saved.arrays.items():
        assert loaded.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded.arrays[name], array)
    assert os.listdir(path.parent) == ["map.npz"]


def test_damage_anywhere_is_noticed(tmp_path):
    path = tmp_path / "map.npz"
    save_checkpoint(path, checkpoint())
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(40):
        path.write_bytes(whole[: int(rng.integers(0, len(whole)))])
        with pytest.raises(CheckpointError):
            load_checkpoint(path)
    reference = checkpoint()
    for _ in range(40):
        damaged = bytearray(whole)
        damaged[int(rng.integers(0, len(whole)))] ^= 0x41
        path.write_bytes(bytes(damaged))
        try:
            loaded = load_checkpoint(path)
        except CheckpointError:
            continue
        # A flip the reader accepts may only have hit zip metadata that carries no content.
        for name, array in loaded.arrays.items():
            np.testing.assert_array_equal(array, reference.arrays[name])


def test_objects_are_refused_when_written_and_pickles_when_read(tmp_path):
    path = tmp_path / "map.npz"
    bad = Checkpoint(checkpoint().header, {"x": np.array([{}], dtype=object)})
    with pytest.raises(CheckpointError, match="plain array"):
        save_checkpoint(path, bad)
    np.savez(path, header=np.array([{"format": 1}], dtype=object))
    with pytest.raises(CheckpointError, match="can't be read"):
        load_checkpoint(path)


def test_a_missing_file_and_another_format_are_clear_errors(tmp_path):
    with pytest.raises(CheckpointError, match="can't be read"):
        load_checkpoint(tmp_path / "none.npz")
    np.savez(tmp_path / "old.npz", header=np.frombuffer(b'{"format": 99}', dtype=np.uint8))
    with pytest.raises(CheckpointError, match="another version"):
        load_checkpoint(tmp_path / "old.npz")


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "map.npz"
    save_checkpoint(path, checkpoint(1))

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(CheckpointError, match="No space left"):
        save_checkpoint(path, checkpoint(2))
    assert load_checkpoint(path).header.frame_id == 1
    assert os.listdir(tmp_path) == ["map.npz"]


def test_a_mismatch_names_field_and_values():
    header = checkpoint().header
    assert mismatch(header, {"agent_epoch": 123456789, "camera": CAMERA}) is None
    assert (
        mismatch(header, {"codec_digest": "00" * 8})
        == f"codec_digest is {'ab' * 8!r}, the stream has {'00' * 8!r}"
    )


def test_the_writer_keeps_the_newest_and_ends(tmp_path):
    path = tmp_path / "map.npz"
    writer = CheckpointWriter(path)
    for k in range(20):
        writer.submit(checkpoint(k))
    writer.close()
    writer.close()
    assert load_checkpoint(path).header.frame_id == 19
    assert 1 <= writer.num_written <= 20


def test_the_writer_survives_a_full_disk_says_so_each_time_and_when_it_is_over(tmp_path, caplog):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    told = []
    writer = CheckpointWriter(blocked / "map.npz", told.append)
    for k in (1, 2):
        writer.submit(checkpoint())
        until(lambda k=k: writer.num_failed == k)
    blocked.unlink()
    writer.submit(checkpoint())
    writer.close()
    assert (writer.num_failed, writer.num_written) == (2, 1)
    assert [text.startswith(f"no checkpoint: {blocked}") for text in told] == [True, True]
    assert caplog.text.count("the stream goes on, and the next checkpoint is tried") == 1
    assert caplog.text.count("checkpoints are written again") == 1


def test_the_writer_survives_what_nobody_expected(tmp_path, monkeypatch, caplog):
    def broken(*_args, **_kwargs):
        raise MemoryError

    path = tmp_path / "map.npz"
    writer = CheckpointWriter(path)
    with monkeypatch.context() as patch:
        patch.setattr("semcast.server.checkpoint.save_checkpoint", broken)
        writer.submit(checkpoint(1))
        until(lambda: writer.num_failed)
    writer.submit(checkpoint(2))
    writer.close()
    assert (writer.num_failed, writer.num_written) == (1, 1)
    assert load_checkpoint(path).header.frame_id == 2
    assert "MemoryError; the stream goes on, and the next checkpoint is tried" in caplog.text


@pytest.mark.parametrize("drops", [3, {"superseded": "many"}])
def test_drops_that_are_no_counts_are_damage_and_older_files_have_none(tmp_path, drops):
    path = tmp_path / "map.npz"
    header = {"format": FORMAT, **asdict(checkpoint().header), "camera": CAMERA.to_dict(), "drops": drops}
    write_npz(path, header, {}, compressed=False, durable=False)
    with pytest.raises(CheckpointError, match=r"map.npz can't be read as a checkpoint"):
        load_checkpoint(path)
    del header["drops"]
    write_npz(path, header, {}, compressed=False, durable=False)
    assert load_checkpoint(path).header.drops == {}
