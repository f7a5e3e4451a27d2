import zlib

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.image_file import as_rgb, read_image
from semcast.common.sequence import open_sequence

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)


def test_grey_sixteen_bit_and_transparent_images_become_rgb():
    grey = np.array([[7, 9]], dtype=np.uint8)
    np.testing.assert_array_equal(as_rgb(grey), [[[7, 7, 7], [9, 9, 9]]])
    np.testing.assert_array_equal(as_rgb(np.array([[0x1234]], dtype=np.uint16)), [[[0x12] * 3]])
    bgra = np.array([[[10, 20, 30, 255], [10, 20, 30, 0], [0, 0, 0, 51]]], dtype=np.uint8)
    np.testing.assert_array_equal(as_rgb(bgra), [[[30, 20, 10], [255, 255, 255], [204, 204, 204]]])


@pytest.mark.parametrize(("bits", "brightest"), [(8, 250), (10, 1000), (12, 4000), (14, 9000), (16, 60000)])
def test_images_of_fewer_bits_in_files_of_sixteen_are_as_bright_as_meant(tmp_path, caplog, bits, brightest):
    caplog.set_level("INFO")
    (tmp_path / "images").mkdir()
    for k, top in enumerate((brightest, brightest // 3, brightest)):
        image = np.linspace(0, top, 24 * 32).reshape(24, 32).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), image)
    sequence = open_sequence(tmp_path)
    dark = open_sequence(tmp_path, stride=3, max_frames=1)  # bits are those of the whole recording
    for image, top in ((sequence.image(1), brightest // 3), (dark.image(0), brightest)):
        assert image.max() == top >> (bits - 8)
        assert image.shape == (24, 32, 3)
    assert (f"16-bit images are read as {bits}-bit" in caplog.text) == (bits != 16)
    alone = read_image(tmp_path / "images" / "0.png")
    assert alone.max() == brightest >> (bits - 8), "one by one an image goes by itself"


def test_a_dark_beginning_and_end_do_not_tell_the_bits_of_a_recording(tmp_path):
    (tmp_path / "images").mkdir()
    for k in range(20):
        image = np.full((24, 32), 4000 if 12 <= k < 15 else 200, np.uint16)
        cv2.imwrite(str(tmp_path / "images" / f"{k:02d}.png"), image)
    sequence = open_sequence(tmp_path)
    assert [int(sequence.image(k).max()) for k in (0, 12)] == [200 >> 4, 4000 >> 4]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 0.5, 1.0], [0, 128, 255]),
        ([0.0, 100.0, 255.0], [0, 100, 255]),
        ([-3.0, np.nan, 200.0], [0, 0, 200]),
        ([-np.inf, np.inf, 1.0], [0, 255, 255]),
        ([0.2, 1.0, 1.1], [51, 255, 255]),
        ([99.6, 255.0, 260.0], [100, 255, 255]),
    ],
)
def test_floats_count_to_1_or_to_255_as_their_values_tell(tmp_path, values, expected):
    cv2.imwrite(str(tmp_path / "a.tif"), np.array([values], dtype=np.float32))
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[0, :, 0], expected)


def test_whole_numbers_of_any_type_count_to_255(tmp_path):
    np.testing.assert_array_equal(as_rgb(np.array([[0, 1, 2]], dtype=np.int32))[0, :, 0], [0, 1, 2])
    np.testing.assert_array_equal(as_rgb(np.array([[-5, 90, 255]], dtype=np.int16))[0, :, 0], [0, 90, 255])


def test_floats_of_another_range_are_refused_by_the_name_of_their_file(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), np.array([[0.0, 4000.0]], dtype=np.float32))
    with pytest.raises(SourceError, match=r"a.tif: values must be in 0..1 or 0..255, got up to 4000"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_depth_images_among_those_of_a_colour_camera_are_refused(tmp_path, suffix):
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.color.png"), np.full((24, 32, 3), 100, np.uint8))
        cv2.imwrite(str(tmp_path / f"{k}.depth{suffix}"), np.full((24, 32), 1500, np.uint16))
    sequence = open_sequence(tmp_path)
    assert sequence.image(2)[0, 0, 0] == 100
    with pytest.raises(SourceError, match="1.depth.* is a 16-bit image, .* 8-bit: a depth image"):
        sequence.image(3)
    messages, num_skipped = sequence.refused_images()
    assert [message.split(" ")[0] for message in messages] == [
        str(tmp_path / f"{k}.depth{suffix}") for k in range(3)
    ]
    assert num_skipped == 0


@pytest.mark.parametrize(("suffix", "width_at", "order"), [(".bmp", 18, "little"), (".png", 16, "big")])
def test_sides_beyond_all_limits_are_damage_of_that_image_alone(tmp_path, suffix, width_at, order):
    (tmp_path / "images").mkdir()
    files = [tmp_path / "images" / f"{k}{suffix}" for k in range(3)]
    for file in files:
        cv2.imwrite(str(file), np.full((24, 32), 90, np.uint8))
    damaged = bytearray(files[1].read_bytes())
    damaged[width_at : width_at + 8] = (60_000).to_bytes(4, order) * 2
    if suffix == ".png":  # whose checksum is over the kind and the content of a chunk
        damaged[29:33] = zlib.crc32(damaged[12:29]).to_bytes(4, "big")
    files[1].write_bytes(damaged)
    sequence = open_sequence(tmp_path)
    assert [sequence.image(k).max() for k in (0, 2)] == [90, 90]
    with pytest.raises(SourceError, match=f"1{suffix} is not a readable image"):
        sequence.image(1)


def test_an_image_of_two_values_a_pixel_is_refused_alone(tmp_path):
    header = b"P7\nWIDTH 3\nHEIGHT 2\nDEPTH 2\nMAXVAL 255\nTUPLTYPE GRAYSCALE_ALPHA\nENDHDR\n"
    (tmp_path / "grey.ppm").write_bytes(header + bytes(range(12)))
    with pytest.raises(SourceError, match=r"grey.ppm: images must have 1, 3 or 4 values a pixel, got 2"):
        read_image(tmp_path / "grey.ppm")
