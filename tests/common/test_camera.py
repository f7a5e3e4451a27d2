import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError

CAMERA = Intrinsics(fx=500.0, fy=510.0, cx=319.5, cy=239.5, width=640, height=480)


def test_the_principal_ray_projects_to_the_principal_point():
    np.testing.assert_allclose(
        CAMERA.project([[0, 0, 2.0], [1.0, -0.5, 2.0]]), [[319.5, 239.5], [569.5, 112.0]]
    )


def test_unproject_inverts_project(rng):
    points = rng.uniform([-1, -1, 1], [1, 1, 5], size=(10, 3))
    rays = CAMERA.unproject(CAMERA.project(points))
    np.testing.assert_allclose(rays * points[:, 2:], points)


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(CAMERA.project([[0.1, 0.1, -1.0], [0, 0, 0]])).all()


def test_resizing_moves_pixels_and_intrinsics_alike():
    """A bright dot found in the resized image lies where the resized intrinsics project its ray."""
    image = np.zeros((480, 640), np.float32)
    image[200:204, 100:104] = 1.0
    ray = CAMERA.unproject([[101.5, 201.5]])
    half = cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)
    ys, xs = np.nonzero(half > 0.5)
    np.testing.assert_allclose(CAMERA.scaled_to(320, 240).project(ray), [[xs.mean(), ys.mean()]], atol=1e-6)


def test_resizing_each_side_by_its_own_factor():
    # Pixel centres are integers: the middle of the image stays its middle, (w - 1) / 2.
    small = CAMERA.scaled_to(320, 120)
    assert (small.fx, small.fy, small.cx, small.cy) == (250.0, 127.5, 159.5, 59.5)
    assert (small.width, small.height) == (320, 120)


def test_the_half_diagonal_is_the_angle_from_the_axis_to_a_corner():
    camera = Intrinsics(fx=100.0, fy=200.0, cx=149.5, cy=399.5, width=300, height=800)
    # A corner is 1.5 focal lengths to the side and 2 down.
    assert camera.half_diagonal_rad == pytest.approx(np.arctan(2.5))


def test_json_round_trip(tmp_path):
    camera = replace(CAMERA, distortion=(0.1, -0.2, 0.0, 0.001))
    camera.save(tmp_path / "intrinsics.json")
    assert Intrinsics.load(tmp_path / "intrinsics.json") == camera
    assert camera.undistorted() == CAMERA


def test_the_readout_of_a_rolling_shutter_belongs_to_the_camera(tmp_path):
    rolling = replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0), readout_ms=21.5, readout_from="left")
    rolling.save(tmp_path / "intrinsics.json")
    assert Intrinsics.load(tmp_path / "intrinsics.json") == rolling
    small = rolling.undistorted().scaled_to(320, 240)
    assert (small.readout_ms, small.readout_from) == (21.5, "left")
    without = {key: value for key, value in CAMERA.to_dict().items() if not key.startswith("readout")}
    assert Intrinsics.from_dict(without) == CAMERA


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": -1}, "fx must be a positive"),
        ({"width": 0}, "width must be"),
        ({"distortion": [1, 2]}, "distortion must be"),
        ({"readout_ms": 101}, r"readout_ms must be in \[0, 100\], got 101"),
        ({"readout_ms": "fast"}, "readout_ms must be a finite number, got 'fast'"),
        ({"readout_from": "up"}, "readout_from must be one of top, bottom, left, right, got 'up'"),
        ({"readout_from": ["top"]}, r"readout_from must be one of top, bottom, left, right, got \['top'\]"),
    ],
)
def test_bad_values_are_named(tmp_path, change, message):
    (tmp_path / "i.json").write_text(json.dumps({**CAMERA.to_dict(), **change}))
    with pytest.raises(SourceError, match=message):
        Intrinsics.load(tmp_path / "i.json")


def test_a_missing_key_or_file_is_named(tmp_path):
    (tmp_path / "i.json").write_text('{"fx": 1}')
    with pytest.raises(SourceError, match="i.json: intrinsics need fx .*, missing 'fy'"):
        Intrinsics.load(tmp_path / "i.json")
    with pytest.raises(SourceError, match="can't be read"):
        Intrinsics.load(tmp_path / "none.json")


def test_a_byte_order_mark_does_not_matter(tmp_path):
    (tmp_path / "i.json").write_text(json.dumps(CAMERA.to_dict()), encoding="utf-8-sig")
    assert Intrinsics.load(tmp_path / "i.json") == CAMERA


@pytest.mark.parametrize(
    ("name", "value"),
    [("fx", None), ("cy", "middle"), ("width", [640]), ("height", float("nan")), ("fy", "inf")],
)
def test_a_value_that_is_no_number_is_named(name, value):
    values = {"fx": 500, "fy": "500.5", "cx": 320, "cy": 240, "width": 640, "height": 480.0}
    assert Intrinsics.from_dict(values).fy == 500.5
    with pytest.raises(SourceError, match=f"{name} must be a finite number, got {re.escape(repr(value))}"):
        Intrinsics.from_dict({**values, name: value})
