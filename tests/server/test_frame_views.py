"""What is shown of a frame of which no image came."""

from types import SimpleNamespace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.server.decoder import DecodedArrival
from semcast.server.frame_views import missing_view
from semcast.server.view.frame_view import MISSING, FrameView

CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


@pytest.fixture
def missing():
    def make(received):
        arrival = SimpleNamespace(
            camera=SimpleNamespace(intrinsics=CAMERA),
            message=SimpleNamespace(frame_id=7, t_source_ns=700),
            received=received,
            snr_db=None if received is None else 2.5,
            snr_db_set=3.0,
        )
        return DecodedArrival(arrival, None, 1.0, 0)

    return make


def test_what_can_not_be_decoded_is_grey_without_confidence(missing):
    view = missing_view(missing(object()), {"outage": 3, "stale": 1})
    assert (view.frame_id, view.t_source_ns, view.state, view.T_world_cam) == (7, 700, MISSING, None)
    assert view.image.shape == (48, 64, 3)
    assert (view.image == 128).all()
    assert view.confidence.shape == (48, 64)
    assert not view.confidence.any()
    assert view.scalars == {
        "link/snr_set_db": 3.0,
        "link/snr_estimated_db": 2.5,
        "drops/all": 4.0,
        "drops/outage": 3.0,
        "drops/stale": 1.0,
    }


def test_what_was_lost_on_the_air_leaves_the_image_before_it(missing):
    view = missing_view(missing(None), {"lost_on_air": 1})
    assert view.image is None
    assert view.confidence is None
    assert view.scalars == {"link/snr_set_db": 3.0, "drops/all": 1.0, "drops/lost_on_air": 1.0}


def test_a_frame_that_came_twice_is_no_drop(missing):
    scalars = missing_view(missing(None), {"duplicate": 9, "lost_on_air": 1}).scalars
    assert scalars == {"link/snr_set_db": 3.0, "drops/all": 1.0, "drops/lost_on_air": 1.0}


def test_what_is_not_finite_is_not_plotted(missing):
    decoded = missing(object())
    decoded.arrival.snr_db, decoded.arrival.snr_db_set = np.inf, np.nan
    assert missing_view(decoded, {}).scalars == {"drops/all": 0.0}


def test_what_waits_for_the_scene_holds_no_image():
    pose, added = np.eye(4), ((2, 200, np.eye(4)),)
    pixels, ones = np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32)
    view = FrameView(
        3,
        300,
        pose,
        "tracking",
        {"a": 1.0},
        pixels,
        ones,
        np.ones((5, 2), np.float32),
        np.ones(5, bool),
        added,
    )
    light = view.without_image()
    assert (light.image, light.confidence) == (None, None)
    assert (light.keypoints_xy.shape, light.keypoint_inlier.shape) == ((0, 2), (0,))
    assert (light.frame_id, light.t_source_ns, light.state, light.scalars) == (3, 300, "tracking", {"a": 1.0})
    assert light.T_world_cam is pose
    assert light.backfilled is added
