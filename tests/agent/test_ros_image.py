import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from semcast.agent.ros_image import compressed_image_file, raw_image_file
from semcast.common.errors import SourceError

#: Red, green; blue, white.
RGB = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
BGR = RGB[..., ::-1]


def message(pixels, encoding, *, padding=0, is_bigendian=0):
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=is_bigendian,
        step=padded.shape[1],
        data=padded.ravel(),
    )


def pixels_of(file):
    suffix, content = file
    assert suffix == ".png"
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


def with_alpha(pixels):
    return np.concatenate([pixels, np.full((2, 2, 1), 9, np.uint8)], axis=2)


@pytest.mark.parametrize(
    ("pixels", "encoding"),
    [(RGB, "rgb8"), (BGR, "bgr8"), (with_alpha(RGB), "rgba8"), (with_alpha(BGR), "bgra8"), (BGR, "8UC3")],
)
@pytest.mark.parametrize("padding", [0, 3])
def test_colours_are_those_of_the_scene_whatever_their_order(pixels, encoding, padding):
    np.testing.assert_array_equal(pixels_of(raw_image_file(message(pixels, encoding, padding=padding))), BGR)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_stays_grey(encoding):
    grey = np.array([[0, 128, 255]], np.uint8)
    np.testing.assert_array_equal(pixels_of(raw_image_file(message(grey, encoding))), grey)


@pytest.mark.parametrize("is_bigendian", [0, 1])
def test_sixteen_bits_keep_their_values_in_either_order_of_bytes(is_bigendian):
    grey = np.array([[0, 258, 65535]], np.uint16)
    sent = message(grey.astype(">u2" if is_bigendian else "<u2"), "mono16", is_bigendian=is_bigendian)
    np.testing.assert_array_equal(pixels_of(raw_image_file(sent)), grey)


@pytest.mark.parametrize(
    ("encoding", "red_at"),
    [("bayer_rggb8", (0, 0)), ("bayer_bggr8", (1, 1)), ("bayer_gbrg8", (1, 0)), ("bayer_grbg8", (0, 1))],
)
def test_a_mosaic_gets_its_colours(encoding, red_at):
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[red_at[0] :: 2, red_at[1] :: 2] = 200
    pixels = pixels_of(raw_image_file(message(mosaic, encoding)))
    np.testing.assert_array_equal(pixels[4, 4], (0, 0, 200))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_luminance_of_packed_yuv_is_where_the_encoding_says(encoding, order):
    # Two grey pixels, the brightest and a dark one, with no colour.
    values = {"y": iter((235, 81)), "u": iter((128,)), "v": iter((128,))}
    packed = np.array([[next(values[name]) for name in order]], np.uint8).reshape(1, 2, 2)
    pixels = pixels_of(raw_image_file(message(packed, encoding)))
    np.testing.assert_allclose(pixels[0, :, 1], (255, (81 - 16) * 255 / 219), atol=1.0)


@pytest.mark.parametrize(("encoding", "red_at"), [("bayer_rggb16", (0, 0)), ("bayer_grbg16", (0, 1))])
def test_a_mosaic_of_sixteen_bits_keeps_them(encoding, red_at):
    mosaic = np.zeros((8, 8), np.uint16)
    mosaic[red_at[0] :: 2, red_at[1] :: 2] = 50_001
    pixels = pixels_of(raw_image_file(message(mosaic, encoding)))
    np.testing.assert_array_equal(pixels[4, 4], (0, 0, 50_001))


@pytest.mark.parametrize(("encoding", "blue_first"), [("nv12", True), ("nv21", False)])
@pytest.mark.parametrize("padding", [0, 6])
def test_rows_of_colour_below_those_of_brightness_are_read(encoding, blue_first, padding):
    # The left half is red, the right half grey and brighter; of each pair of colours the first is Cb in nv12.
    bright = np.repeat(np.array([[81, 81, 180, 180]], np.uint8), 4, axis=0)
    colour = np.repeat(np.array([[90, 240, 128, 128] if blue_first else [240, 90, 128, 128]], np.uint8), 2, 0)
    sent = message(np.concatenate([bright, colour]), encoding, padding=padding)
    sent.height = 4
    pixels = pixels_of(raw_image_file(sent)).astype(int)
    assert pixels.shape == (4, 4, 3)
    np.testing.assert_allclose(pixels[:, 0], np.tile((0, 0, 255), (4, 1)), atol=3)
    np.testing.assert_allclose(pixels[:, 3], 191, atol=1)


@pytest.mark.parametrize(("shape", "told"), [((6, 3), "even width, got 3"), ((4, 4), "even height, got 3")])
def test_half_of_four_pixels_of_a_colour_is_refused(shape, told):
    sent = message(np.zeros(shape, np.uint8), "nv12")
    sent.height = 4 if shape[1] == 3 else 3
    with pytest.raises(SourceError, match=f"an image of nv12 must have an {told}"):
        raw_image_file(sent)


def test_a_depth_image_is_refused():
    with pytest.raises(SourceError, match=r"got '16UC1' \(a depth image\?\)"):
        raw_image_file(message(np.zeros((2, 2), np.uint16), "16UC1"))


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_half_a_pair_of_packed_pixels_is_refused(encoding):
    with pytest.raises(SourceError, match=f"an image of {encoding} must have an even width, got 3"):
        raw_image_file(message(np.zeros((2, 3, 2), np.uint8), encoding))


def test_rows_shorter_than_the_image_are_refused():
    sent = message(RGB, "rgb8")
    sent.width = 3
    with pytest.raises(SourceError, match="3x2 rgb8 must have rows of at least 9 bytes, got 6"):
        raw_image_file(sent)


def test_data_of_another_length_are_refused():
    sent = message(RGB, "rgb8")
    sent.data = sent.data[:-1]
    with pytest.raises(SourceError, match="2 rows of 6 bytes must be 12 bytes, got 11"):
        raw_image_file(sent)


def packed(pixels, suffix, form):
    _, content = cv2.imencode(suffix, pixels)
    return SimpleNamespace(format=form, data=content.ravel())


@pytest.mark.parametrize(
    ("suffix", "form"), [(".jpg", "rgb8; jpeg compressed bgr8"), (".png", "png"), (".webp", "webp")]
)
def test_a_compressed_image_is_kept_byte_by_byte(suffix, form):
    sent = packed(BGR, suffix, form)
    assert compressed_image_file(sent) == (suffix, sent.data.tobytes())


def test_a_compressed_mosaic_gets_its_colours():
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[::2, ::2] = 200
    sent = packed(mosaic, ".png", "bayer_rggb8; png compressed bayer_rggb8")
    np.testing.assert_array_equal(pixels_of(compressed_image_file(sent))[4, 4], (0, 0, 200))


def test_a_compressed_mosaic_of_sides_beyond_all_limits_is_refused():
    sent = packed(np.zeros((8, 8), np.uint8), ".png", "bayer_rggb8; png compressed bayer_rggb8")
    content = bytearray(sent.data.tobytes())
    content[16:24] = (60_000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    sent.data = np.frombuffer(bytes(content), np.uint8)
    with pytest.raises(SourceError, match="must be grey, and is not"):
        compressed_image_file(sent)


@pytest.mark.parametrize(
    "sent",
    [
        SimpleNamespace(format="h264", data=np.frombuffer(b"\x00\x00\x00\x01\x67", np.uint8)),
        packed(BGR, ".png", "16UC1; compressedDepth png"),
    ],
    ids=["video", "depth"],
)
def test_what_is_no_picture_is_refused(sent):
    with pytest.raises(SourceError, match=f"must be JPEG, PNG or WebP pictures, got '{sent.format}'"):
        compressed_image_file(sent)
