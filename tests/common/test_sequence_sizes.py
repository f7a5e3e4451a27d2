import cv2
import numpy as np
import pytest

from semcast.common.sequence_sizes import size_in_header_wh


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(0).integers(0, 255, (24, 40, 3), dtype=np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_header_states_the_size(tmp_path, noise, suffix, channels):
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), noise[:, :, 0] if channels == 1 else noise)
    assert size_in_header_wh(path) == (40, 24)
    # Not the end of a file that would still decode: only decoding tells.
    path.write_bytes(path.read_bytes() + b"more")
    assert size_in_header_wh(path) is None


def test_a_progressive_jpeg_with_notes_before_its_size_is_read(tmp_path, noise):
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    whole = path.read_bytes()
    note = b"\xff\xe1" + (2 + 60_000).to_bytes(2, "big") + b"\xff\xc0" * 30_000
    path.write_bytes(whole[:2] + 3 * note + whole[2:])
    assert size_in_header_wh(path) == (40, 24)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_file_that_is_cut_off_states_nothing(tmp_path, noise, suffix, share):
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), noise)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert size_in_header_wh(path) is None


@pytest.mark.parametrize(
    "content", [b"\xff\xd8\xff\xd9", b"\xff\xd8\xff\xe1\x00\x00\xff\xd9", b"\xff\xd8abcdefgh\xff\xd9"]
)
def test_a_jpeg_without_a_frame_states_nothing(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    assert size_in_header_wh(tmp_path / "a.jpg") is None


def test_other_formats_and_missing_files_state_nothing(tmp_path, noise):
    cv2.imwrite(str(tmp_path / "a.bmp"), noise)
    assert size_in_header_wh(tmp_path / "a.bmp") is None
    assert size_in_header_wh(tmp_path / "none.png") is None
