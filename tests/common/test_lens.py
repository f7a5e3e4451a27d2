import pytest

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError

PINHOLE = {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}
RATIONAL = [0.1, -0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6]


@pytest.mark.parametrize(
    ("written", "kept"),
    [
        ([*RATIONAL, *[0.0] * 6], 8),
        ([*RATIONAL, *[0.0] * 4], 8),
        ([*RATIONAL[:5], 0.0, 0.0, 0.0], 5),
        ([0.1, -0.2, 0.0, 0.0, 0.0], 4),
        ([0.0] * 5, 0),
    ],
)
@pytest.mark.parametrize("key", ["distortion", "distortion_coeffs", "distortion_coefficients"])
def test_zeros_of_a_longer_distortion_model_are_left_off(written, kept, key):
    assert Intrinsics.from_dict({**PINHOLE, key: written}).distortion == tuple(written[:kept])


def test_a_longer_distortion_model_that_is_used_is_refused():
    with pytest.raises(SourceError, match="distortion must be 0, 4, 5 or 8 finite values"):
        Intrinsics.from_dict({**PINHOLE, "distortion": [*RATIONAL, 0.0, 0.0, 0.01, 0.0]})


@pytest.mark.parametrize(
    "lens",
    [
        {"distortion": [-0.3, 0.1, 0.01, 0.02]},
        {"D": [-0.3, 0.1, 0.01, 0.02, 0.0], "distortion_model": "plumb_bob"},
        {"dist_coeffs": [[-0.3, 0.1, 0.01, 0.02, 0]]},
        {"k1": -0.3, "k2": 0.1, "p1": 0.01, "p2": 0.02, "camera_model": "OPENCV"},
        {"distortion": {"k1": -0.3, "k2": 0.1, "p1": 0.01, "p2": 0.02}},
        {"distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.3, 0.1, 0.01, 0.02, 0]}},
        {"D": [-0.3, 0.1, 0.01, 0.02], "distortion_model": "none given", "distortion": []},
        {"d": [-0.3, 0.1, 0.01, 0.02, 0.0]},
        {"coeffs": [-0.3, 0.1, 0.01, 0.02, 0.0], "model": "distortion.brown_conrady"},
    ],
)
def test_distortion_is_read_under_its_usual_names(lens):
    assert Intrinsics.from_dict({**PINHOLE, **lens}).distortion == (-0.3, 0.1, 0.01, 0.02)


@pytest.mark.parametrize(
    "lens",
    [
        {"distortion_model": "none given: rectified"},
        {"distortion": None, "camera_model": "a phone of 2021"},
        {"distortion": [], "distortion_coeffs": 0},
        {"distortion": "none", "undistorted": True, "distance_unit": "m"},
        {"distortion_model": "none (not a fisheye)", "is_fisheye": False},
        {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0, 0.0, 0.0, 0.0, 0.0]},
    ],
)
def test_notes_about_a_lens_without_distortion_are_ignored(lens):
    assert Intrinsics.from_dict({**PINHOLE, **lens}).distortion == ()


@pytest.mark.parametrize(
    "lens",
    [
        {"distortion_model": "equidistant", "D": [0.1, -0.2, 0.01, 0.02]},
        {"distortion_model": "equidistant", "camera_model": "pinhole", "D": [0.1, -0.2, 0.01, 0.02, 0.0]},
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": -0.2, "k3": 0.01, "k4": 0.02, "p1": 0, "p2": 0},
        {"is_fisheye": True, "k1": 0.1, "k2": -0.2, "k3": 0.01, "k4": 0.02},
        {"type": "KannalaBrandt8", "k1": 0.1, "k2": -0.2, "k3": 0.01, "k4": 0.02},
        {"model": "distortion.kannala_brandt4", "coeffs": [0.1, -0.2, 0.01, 0.02, 0.0]},
        {"distortion": {"model": "equidistant", "k1": 0.1, "k2": -0.2, "k3": 0.01, "k4": 0.02}},
    ],
)
def test_a_fisheye_is_read_under_its_usual_names(lens):
    camera = Intrinsics.from_dict({**PINHOLE, **lens})
    assert camera.distortion_model == "equidistant"
    assert camera.distortion == (0.1, -0.2, 0.01, 0.02)
    assert Intrinsics.from_dict(camera.to_dict()) == camera


def test_a_fisheye_without_coefficients_is_no_pinhole():
    camera = Intrinsics.from_dict({**PINHOLE, "fisheye": 1})
    assert camera.distortion == (0.0, 0.0, 0.0, 0.0)
    assert camera.is_distorted
    assert not camera.undistorted().is_distorted


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ({"distortion_model": "omni-equidistant", "D": [0.1, 0, 0, 0]}, "distortion_model .* got 'omni-equi"),
        ({"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.1}, "camera_model .* got 'THIN_PRISM_FISHEYE'"),
        (
            {"camera_model": "OPENCV_FISHEYE", "distortion_model": "radtan"},
            "camera_model and distortion_model",
        ),
        (
            {"is_fisheye": True, "k1": 0.1, "p1": 0.01},
            "distortion must be 4 finite values .k1 to k4 of a fish",
        ),
        ({"distortion_model": "equidistant", "D": [0.1, 0.2, 0.3]}, "distortion must be 4 finite values"),
        ({"distortion": "-0.3 0.1 0 0"}, "distortion must be a list of numbers"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "distortion_params must be a list of numbers named"),
        ({"dist": [0.1, "x", 0, 0]}, "dist must be of numbers, got 'x'"),
        ({"k1": None}, "k1 must be of numbers, got None"),
        ({"D": [[0.1], [0], [0], [0]]}, r"D must be of numbers, got \[0.1\]"),
        ({"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1}, "k4 must be 0 or come with k5 and k6, got 0.1"),
        ({"distortion": {"model": "double_sphere", "k1": 0.1}}, "model must be a pinhole camera's"),
        ({"distortion": {"values": [0.1, 0, 0, 0]}}, "distortion must be a list of numbers named"),
        (
            {"model": "inverse_brown_conrady", "coeffs": [0.1, 0, 0, 0]},
            "model must map .* got 'inverse_brown",
        ),
        ({"lens_distortion": [0.1, 0, 0, 0]}, "lens_distortion must be a list of numbers named"),
        ({"distortion_model": "division", "D": [0.1, 0, 0, 0]}, "distortion_model must be .* got 'division'"),
        ({"k1": 0.1, "D": [0.2, 0, 0, 0]}, "k1 and D must say the same"),
    ],
)
def test_a_lens_that_is_not_understood_is_refused(lens, message):
    with pytest.raises(SourceError, match=message):
        Intrinsics.from_dict({**PINHOLE, **lens})
