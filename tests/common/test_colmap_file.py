import struct

import numpy as np
import pycolmap
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import invert_transform, quat_wxyz_from_rotation
from semcast.common.sequence import open_sequence

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)
PINHOLE = (1, "PINHOLE", (30.0, 31.0, 16.0, 12.0))


def _images(poses, names):
    """Rows of COLMAP's images: number, pose of the world in the camera, name."""
    rows = []
    for k, (T, name) in enumerate(zip(invert_transform(poses), names, strict=True)):
        rows.append((k + 7, [*quat_wxyz_from_rotation(T[:3, :3]), *T[:3, 3]], name))
    return rows


def _write_text(folder, cameras, images):
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{k} {model} 32 24 {' '.join(map(str, values))}"
        for k, (_, model, values) in enumerate(cameras, start=1)
    ]
    (folder / "cameras.txt").write_text("\n".join(["# Camera list", *lines]) + "\n")
    text = "# Image list with two lines of data per image\n"
    for place, (number, pose, name) in enumerate(images):
        text += f"{number} {' '.join(map(repr, map(float, pose)))} {min(place + 1, len(cameras))} {name}\n"
        text += "\n" if place == 0 else "1.5 2.5 -1 3.5 4.5 8\n"
    (folder / "images.txt").write_text(text)


def _write_binary(folder, cameras, images):
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(cameras))
    for k, (number, _, values) in enumerate(cameras, start=1):
        data += struct.pack("<iiQQ", k, number, 32, 24) + struct.pack(f"<{len(values)}d", *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for place, (number, pose, name) in enumerate(images):
        data += struct.pack("<i7di", number, *pose, min(place + 1, len(cameras))) + name.encode() + b"\0"
        data += struct.pack("<Q", 2 * (place % 2)) + place % 2 * struct.pack(
            "<ddqddq", 1.5, 2.5, -1, 3.5, 4.5, 8
        )
    (folder / "images.bin").write_bytes(data)


WRITERS = {"txt": _write_text, "bin": _write_binary}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_images_get_the_camera_and_the_poses_of_the_model_beside_them(
    tmp_path, write_images, poses, write, place
):
    write_images(tmp_path / "images", 12, "photo {:d}.png")
    order = [11, 2, 0, 10]
    names = [f"photo {k}.png" for k in order]
    write(tmp_path / place, [PINHOLE], _images(poses(12)[order], names))
    sequence = open_sequence(tmp_path)
    assert [int(sequence.image(k)[0, 0, 0]) for k in range(len(sequence))] == [0, 20, 100, 110]
    assert sequence.intrinsics == CAMERA
    np.testing.assert_allclose(sequence.groundtruth().T_world_cam, poses(12)[sorted(order)], atol=1e-12)
    np.testing.assert_allclose(sequence.groundtruth().t_s, [0.0, 0.1, 0.2, 0.3])


def test_what_colmap_itself_writes_is_read(tmp_path, write_images, poses):
    write_images(tmp_path / "images", 3)
    names = [f"{k:06d}.png" for k in range(3)]
    _write_text(tmp_path / "text", [PINHOLE], _images(poses(3), names))
    # Points in images must be in the list of points; none are needed here.
    lines = (tmp_path / "text" / "images.txt").read_text().splitlines()
    kept = [line for line in lines if line.endswith(".png")]
    (tmp_path / "text" / "images.txt").write_text("".join(f"{line}\n\n" for line in kept))
    (tmp_path / "text" / "points3D.txt").write_text("")
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    pycolmap.Reconstruction(tmp_path / "text").write_binary(tmp_path / "sparse" / "0")
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == CAMERA
    np.testing.assert_allclose(sequence.groundtruth().T_world_cam, poses(3), atol=1e-12)


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
@pytest.mark.parametrize(
    ("camera", "focal_px", "distortion"),
    [
        ((0, "SIMPLE_PINHOLE", (30.0, 16.0, 12.0)), (30.0, 30.0), ()),
        ((2, "SIMPLE_RADIAL", (30.0, 16.0, 12.0, 0.1)), (30.0, 30.0), (0.1, 0.0, 0.0, 0.0)),
        ((3, "RADIAL", (30.0, 16.0, 12.0, 0.1, 0.2)), (30.0, 30.0), (0.1, 0.2, 0.0, 0.0)),
        ((4, "OPENCV", (30.0, 31.0, 16.0, 12.0, 0.1, 0.2, 0.3, 0.4)), (30.0, 31.0), (0.1, 0.2, 0.3, 0.4)),
        ((4, "OPENCV", (30.0, 31.0, 16.0, 12.0, 0.0, 0.0, 0.0, 0.0)), (30.0, 31.0), ()),
        (
            (6, "FULL_OPENCV", (30.0, 31.0, 16.0, 12.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)),
            (30.0, 31.0),
            (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        ),
    ],
)
def test_models_are_read_in_the_order_of_opencv(
    tmp_path, write_images, poses, write, camera, focal_px, distortion
):
    write_images(tmp_path / "images", 1)
    write(tmp_path / "sparse" / "0", [camera], _images(poses(1), ["000000.png"]))
    found = open_sequence(tmp_path).stored_camera
    assert (found.fx, found.fy) == focal_px
    assert (found.cx, found.cy) == (15.5, 11.5)
    assert found.distortion == distortion


def test_a_model_of_large_images_serves_small_copies_of_them(tmp_path, write_images, poses):
    write_images(tmp_path / "images", 1, size=(12, 16))
    _write_binary(tmp_path / "sparse" / "0", [PINHOLE], _images(poses(1), ["000000.png"]))
    found = open_sequence(tmp_path).intrinsics
    assert (found.fx, found.fy, found.cx, found.cy) == (15.0, 15.5, 7.5, 5.5)


@pytest.mark.parametrize(("gone", "kept"), [("images", "cameras"), ("cameras", "images")])
def test_half_a_model_is_said_not_to_be_used(tmp_path, write_images, poses, caplog, gone, kept):
    write_images(tmp_path / "images", 1)
    _write_binary(tmp_path / "sparse" / "0", [PINHOLE], _images(poses(1), ["000000.png"]))
    assert open_sequence(tmp_path).intrinsics == CAMERA
    assert not caplog.records
    (tmp_path / "sparse" / "0" / f"{gone}.bin").unlink()
    assert open_sequence(tmp_path).groundtruth() is None
    assert f"{kept}.bin is half a model of COLMAP's, without {gone}.bin or {gone}.txt: images" in caplog.text
    caplog.clear()
    CAMERA.save(tmp_path / "intrinsics.json")
    assert open_sequence(tmp_path).intrinsics == CAMERA
    assert not caplog.records, "files of its own go before a model, whole or half"


def test_images_of_another_shape_than_the_model_s_are_refused(tmp_path, write_images, poses):
    write_images(tmp_path / "images", 1, size=(16, 16))
    _write_binary(tmp_path / "sparse" / "0", [PINHOLE], _images(poses(1), ["000000.png"]))
    with pytest.raises(SourceError, match="are for 32x24 images, its images are 16x16"):
        open_sequence(tmp_path)


def test_a_calibration_or_transforms_of_its_own_go_before_the_model(tmp_path, write_images, poses):
    write_images(tmp_path / "images", 3)
    _write_binary(tmp_path / "sparse" / "0", [PINHOLE], _images(poses(1), ["000000.png"]))
    assert len(open_sequence(tmp_path)) == 1
    (tmp_path / "transforms.json").write_text('{"fl_x": 50, "frames": []}')
    with pytest.raises(SourceError, match="no images in"):
        open_sequence(tmp_path)
    CAMERA.save(tmp_path / "intrinsics.json")
    assert len(open_sequence(tmp_path)) == 3
    assert len(open_sequence(tmp_path, layout="colmap")) == 1


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.yaml", "fx: 30\nfy: 31\ncx: 15.5\ncy: 11.5\nwidth: 32\nheight: 24\n"),
        ("times.txt", "0.0\n0.5\n1.5\n"),
        ("groundtruth.txt", "0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n"),
    ],
)
def test_a_folder_of_semcast_s_own_stays_one_when_colmap_ran_in_it(tmp_path, write_images, poses, name, text):
    write_images(tmp_path / "images", 3)
    _write_binary(tmp_path / "sparse" / "0", [PINHOLE], _images(poses(1), ["000000.png"]))
    (tmp_path / name).write_text(text)
    assert len(open_sequence(tmp_path, intrinsics=CAMERA)) == 3


def test_photos_that_were_not_posed_are_left_out_and_counted(tmp_path, write_images, poses, caplog):
    write_images(tmp_path / "images", 3)
    _write_text(tmp_path / "sparse" / "0", [PINHOLE], _images(poses(1), ["000000.png"]))
    with caplog.at_level("INFO"):
        open_sequence(tmp_path)
    assert "has 3 images, of which COLMAP has posed 1: these are used" in caplog.text


@pytest.mark.parametrize(
    ("second_px", "message"), [(30.2, None), (33.0, r"fx must be the same for all .*, got 30 to 33")]
)
def test_cameras_fitted_to_each_image_are_one_if_they_hardly_differ(
    tmp_path, write_images, poses, second_px, message
):
    write_images(tmp_path / "images", 2)
    cameras = [PINHOLE, (1, "PINHOLE", (second_px, 31.0, 16.0, 12.0))]
    _write_binary(tmp_path / "sparse" / "0", cameras, _images(poses(2), ["000000.png", "000001.png"]))
    if message is None:
        assert open_sequence(tmp_path).intrinsics == CAMERA
        return
    with pytest.raises(SourceError, match=message):
        open_sequence(tmp_path)


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_an_unknown_camera_is_refused(tmp_path, write_images, poses, write):
    write_images(tmp_path / "images", 1)
    camera = (7, "FOV", (30.0, 31.0, 16.0, 12.0, 0.1))
    write(tmp_path / "sparse" / "0", [camera], _images(poses(1), ["000000.png"]))
    with pytest.raises(SourceError, match=r"the camera model must be one of .*, got FOV"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
@pytest.mark.parametrize(
    ("camera", "distortion"),
    [
        ((5, "OPENCV_FISHEYE", (30.0, 31.0, 16.0, 12.0, 0.1, 0.2, 0.3, 0.4)), (0.1, 0.2, 0.3, 0.4)),
        ((8, "SIMPLE_RADIAL_FISHEYE", (30.0, 16.0, 12.0, 0.0)), (0.0, 0.0, 0.0, 0.0)),
        ((9, "RADIAL_FISHEYE", (30.0, 16.0, 12.0, 0.1, 0.2)), (0.1, 0.2, 0.0, 0.0)),
    ],
    ids=["opencv", "simple radial", "radial"],
)
def test_a_fisheye_is_read_as_one(tmp_path, write_images, poses, write, camera, distortion):
    write_images(tmp_path / "images", 1)
    write(tmp_path / "sparse" / "0", [camera], _images(poses(1), ["000000.png"]))
    stored = open_sequence(tmp_path).stored_camera
    assert (stored.distortion_model, stored.distortion) == ("equidistant", distortion)
    assert (stored.fx, stored.cx, stored.cy) == (30.0, 15.5, 11.5)


def _cut(path, count):
    path.write_bytes(path.read_bytes()[:count])


def _put(path, behind, new):
    data = path.read_bytes()
    at = data.index(behind) + len(behind)
    path.write_bytes(data[:at] + new + data[at + len(new) :])


def _replace(path, old, new):
    path.write_text(path.read_text().replace(old, new))


DAMAGES = {
    "images cut off": (
        _write_binary,
        lambda f: _cut(f / "images.bin", 90),
        "images.bin can't be used as COLMAP's: it ends too early",
    ),
    "a name cut off": (
        _write_binary,
        lambda f: _cut(f / "images.bin", 80),
        "images.bin can't be used as COLMAP's: it ends within the name of an image",
    ),
    "points without end": (
        _write_binary,
        lambda f: _put(f / "images.bin", b"000000.png\0", struct.pack("<Q", 2**63)),
        "images.bin can't be used as COLMAP's: it ends within the points of 000000.png",
    ),
    "cameras cut off": (
        _write_binary,
        lambda f: _cut(f / "cameras.bin", 40),
        "cameras.bin can't be used as COLMAP's: it ends too early",
    ),
    "unknown number": (
        _write_binary,
        lambda f: (f / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, 77, 32, 24)),
        "camera 1 is of model 77, known are 0 to 10",
    ),
    "no images": (
        _write_binary,
        lambda f: (f / "images.bin").write_bytes(bytes(8)),
        "has no image with a pose",
    ),
    "no camera": (
        _write_binary,
        lambda f: (f / "cameras.bin").write_bytes(bytes(8)),
        "has no camera 1, which took",
    ),
    "no number": (
        _write_text,
        lambda f: _replace(f / "images.txt", "7 1.0", "7 one"),
        "images.txt can't be used",
    ),
    "no pose": (
        _write_text,
        lambda f: _replace(f / "images.txt", "7 1.0", "7 nan"),
        "the pose of 000000.png must be finite",
    ),
    "no name": (
        _write_text,
        lambda f: _replace(f / "images.txt", " 000000.png", ""),
        "an image must have a number, a pose of 7, a camera and a name, got '7 1.0 ",
    ),
    "no lines of points": (
        _write_text,
        lambda f: _replace(f / "images.txt", "\n\n", "\n"),
        "after the line of 000000.png must come that of its points",
    ),
    "a width beyond all bounds": (
        _write_text,
        lambda f: _replace(f / "cameras.txt", " 32 ", f" 1{400 * '0'} "),
        "holds no usable intrinsics: ",
    ),
    "a parameter short": (
        _write_text,
        lambda f: _replace(f / "cameras.txt", " 12.0", ""),
        "PINHOLE must have 4 parameters, got 3",
    ),
}


@pytest.mark.parametrize(("write", "damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_what_is_wrong_with_a_model_is_said(tmp_path, write_images, poses, write, damage, message):
    write_images(tmp_path / "images", 2)
    folder = tmp_path / "sparse" / "0"
    write(folder, [PINHOLE], _images(poses(2), ["000000.png", "000001.png"]))
    damage(folder)
    with pytest.raises(SourceError, match=message):
        open_sequence(tmp_path)


def test_a_folder_without_a_model_is_no_model_of_colmap(tmp_path, write_images):
    write_images(tmp_path / "images", 1)
    with pytest.raises(SourceError, match=r"must have sparse/0/cameras.bin and images.bin, or .txt"):
        open_sequence(tmp_path, layout="colmap")
