"""Transparency comes out of a TIFF as out of a PNG, however it is stored."""

import struct

import cv2
import numpy as np
import pytest

from semcast.common.image_file import read_image
from semcast.common.tiff_alpha import is_laid_on_black

NOT_SAID, ASSOCIATED, UNASSOCIATED = 0, 1, 2


def tiff(rgba, extra_samples, order):
    """A TIFF of one uncompressed strip that says what its fourth values are."""
    height, width, count = rgba.shape
    pixels = rgba.astype(rgba.dtype.newbyteorder(order)).tobytes()
    end = 8 + 2 + 12 * 11 + 4
    short, long = 3, 4
    tags = [
        *((256, short, 1, width), (257, short, 1, height), (258, short, count, end), (259, short, 1, 1)),
        *((262, short, 1, 2), (273, long, 1, end + 8), (277, short, 1, count), (278, short, 1, height)),
        *((279, long, 1, len(pixels)), (284, short, 1, 1), (338, short, 1, extra_samples)),
    ]
    out = {"<": b"II", ">": b"MM"}[order] + struct.pack(order + "HIH", 42, 8, len(tags))
    for tag, kind, num, value in tags:
        form = "HHIHH" if kind == short and num == 1 else "HHII"
        out += struct.pack(order + form, tag, kind, num, value, *([0] if form == "HHIHH" else []))
    return out + struct.pack(order + "I4H", 0, *[8 * rgba.itemsize] * count) + pixels


@pytest.fixture(scope="module")
def rgba():
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 4), dtype=np.uint8)
    image[0, :, 3] = (0, 255, 0, 255, 1, 254, 128, 127)
    image[1, 1:3] = 255  # all 16 bits are in use
    return image


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("stored", [NOT_SAID, ASSOCIATED, UNASSOCIATED])
def test_a_transparent_tiff_looks_like_the_png(tmp_path, rgba, dtype, stored, order):
    cv2.imwrite(str(tmp_path / "a.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    values = rgba.copy()
    if stored == ASSOCIATED:
        values[:, :, :3] = np.rint(rgba[:, :, :3] * (rgba[:, :, 3:] / 255.0))
    values = values.astype(dtype) * (257 if dtype == np.uint16 else 1)
    (tmp_path / "a.tiff").write_bytes(tiff(values, stored, order))
    seen = [read_image(tmp_path / name).astype(int) for name in ("a.png", "a.tiff")]
    assert np.abs(seen[0] - seen[1]).max() <= 1


def test_opencv_s_own_tiff_looks_like_its_png(tmp_path, rgba):
    for name in ("a.png", "a.tiff"):
        cv2.imwrite(str(tmp_path / name), rgba)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), read_image(tmp_path / "a.tiff"))


def test_what_is_no_whole_tiff_says_nothing(rgba):
    whole = tiff(rgba, ASSOCIATED, "<")
    assert is_laid_on_black(whole, 8)
    assert not any(is_laid_on_black(data, 8) for data in (b"", b"\x89PNG\r\n", whole[:7], whole[:60]))
