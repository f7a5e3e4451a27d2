"""What a file states about its size is read as decoders read it, and no more than that is decoded."""

import cv2
import numpy as np
import pytest

from semcast.common.conventional_source import decompress
from semcast.common.image_header import stated_size_wh, states_at_most

KINDS = {
    "jpeg": [],
    "png": [],
    "avif": [],
    "webp": [cv2.IMWRITE_WEBP_QUALITY, 30],
    "lossless.webp": [cv2.IMWRITE_WEBP_QUALITY, 101],
}


def file_of(kind, shape, parameters=None):
    image = np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)
    done, data = cv2.imencode("." + kind.rpartition(".")[2], image, parameters or KINDS[kind])
    assert done
    return data.tobytes()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(48, 64, 3), (31, 270, 3), (300, 17, 3)])
def test_the_size_is_that_of_the_decoded_image(kind, shape):
    data = file_of(kind, shape)
    assert stated_size_wh(data) == shape[1::-1]
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == shape


def test_files_with_alpha_and_progressive_ones_are_read_too():
    assert stated_size_wh(file_of("webp", (40, 50, 4), [cv2.IMWRITE_WEBP_QUALITY, 50])) == (50, 40)
    assert stated_size_wh(file_of("avif", (40, 50, 4))) == (50, 40)
    assert stated_size_wh(file_of("jpeg", (40, 50, 3), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])) == (50, 40)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_is_cut_off_or_no_image_states_nothing_and_raises_nothing(kind):
    data = file_of(kind, (48, 64, 3))
    for length in range(24):
        assert stated_size_wh(data[:length]) is None
    for length in range(24, 400):
        assert stated_size_wh(data[:length]) in (None, (64, 48))
    assert stated_size_wh(bytes(1000)) is None
    assert stated_size_wh(b"GIF89a" + bytes(100)) is None


@pytest.mark.parametrize("kind", ["jpeg", "webp", "avif"])
def test_a_file_that_states_more_pixels_than_a_frame_has_is_not_decoded(kind, monkeypatch):
    data = file_of(kind, (48, 64, 3))
    assert states_at_most(data, (48, 64))
    assert decompress(data, (96, 128)).shape == (96, 128, 3), "a smaller one is scaled up"
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    for shape_hw in ((47, 64), (48, 63), (16, 16)):
        assert decompress(data, shape_hw) is None


def test_what_decoders_would_read_in_another_way_states_nothing():
    data = file_of("jpeg", (48, 64, 3))
    for marker in (b"\xff\xff", b"\xff\x01", b"\xff\xd0"):
        assert stated_size_wh(data[:2] + marker + data[2:]) is None
    assert stated_size_wh(data[:2] + b"\xff\xfe\x00\x01" + data[2:]) is None, (
        "a segment shorter than its length"
    )
    data = file_of("avif", (48, 64, 3))
    for length in (0, 1, 7):
        assert stated_size_wh(length.to_bytes(4, "big") + data[4:]) is None


def test_bytes_of_a_coded_picture_are_no_size():
    data = file_of("avif", (48, 64, 3)) + b"ispe" + b"\xff" * 12
    assert stated_size_wh(data) == (64, 48)
    assert b"mdat" in data[: data.rfind(b"ispe")]
