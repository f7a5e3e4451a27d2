"""Scenes are drawn as lenses with distortion show them."""

import copy
import functools
from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.sequence import ImageRectifier
from semcast.evaluation.scenes.optics import Optics
from semcast.evaluation.scenes.render import SCENES, RenderSettings, frame_of, render_scene

BARREL, PINCUSHION = (-0.28, 0.07, 0.001, -0.001), (0.15, 0.0, 0.0, 0.0)


@functools.cache
def painted(name):
    """Make a scene once: painting its surfaces takes longer than drawing a picture of them."""
    return SCENES[name](3, "fast")


@pytest.fixture(scope="module", autouse=True)
def forgotten():
    """Let scenes go when they were all looked at: each holds a hundred megabytes."""
    yield
    painted.cache_clear()
    seen.cache_clear()


@functools.cache
def seen(distortion, readout_s=0.0, name="room", model="radtan"):
    scene = copy.copy(painted(name))
    scene.camera = replace(scene.camera, distortion=distortion, distortion_model=model)
    return frame_of(scene, 2.0, 0.0, np.random.default_rng(0), readout_s).astype(float), scene.camera


@pytest.mark.parametrize("name", ["room", "street"])
@pytest.mark.parametrize(
    ("distortion", "model"),
    [(BARREL, "radtan"), (PINCUSHION, "radtan"), ((0.05, -0.02, 0.0, 0.0), "equidistant")],
)
def test_undistorted_it_is_the_pinhole_cameras_image(name, distortion, model):
    straight, _ = seen((), name=name)
    bent, camera = seen(distortion, name=name, model=model)
    rectified = ImageRectifier(camera, (camera.width, camera.height))(bent.astype(np.uint8))
    inside = (slice(80, -80), slice(100, -100))
    apart = np.abs(rectified - straight)[inside].mean()
    assert apart < 0.25 * np.abs(bent - straight)[inside].mean()


def test_bands_of_a_rolling_shutter_meet():
    at_once, _ = seen(BARREL)
    in_bands, _ = seen(BARREL, readout_s=1e-9)
    assert (np.abs(at_once - in_bands) > 1).mean() < 1e-4  # edges are on either side of a pixel by chance


def test_without_distortion_pixels_stay_where_they_are():
    camera = Intrinsics(fx=500.0, fy=510.0, cx=320.0, cy=240.0, width=640, height=480)
    optics = Optics.of(camera)
    assert (optics.pinhole, optics.margin, optics.rows(10, 20)) == (camera, 0, (10, 20))
    drawn = np.ones((10, 640, 3), np.float32)
    assert optics.bend(drawn, 10, 20) is drawn


def test_a_distortion_that_no_lens_has_is_refused(tmp_path):
    settings = RenderSettings(seconds=0.1, distortion=(-0.9, 0.0, 0.0, 0.0), out=tmp_path / "new")
    with pytest.raises(SourceError, match="must let every pixel .* in front of the camera, got -0.9 0 0 0"):
        render_scene(settings)
    assert not (tmp_path / "new").exists()
    with pytest.raises(ValueError, match=r"distortion must be 0, 4, 5 or 8 finite values, got \("):
        RenderSettings(distortion=(0.1, 0.0, 0.0), out=tmp_path)
