import pytest

from semcast.server.view.frame_view import MISSING
from semcast.server.view.state_text import state_text

FIGURES = {"tracking/inliers": 30.0, "tracking/tracked": 500.0, "link/psnr_db": 25.0}


@pytest.mark.parametrize(
    ("state", "scalars", "text"),
    [
        ("tracking", FIGURES, "**tracking**, frame 7: 30 of 500 keypoints agree with the map"),
        ("lost", FIGURES, "**lost**, frame 7: 30 of 500 keypoints agree with the map, too few"),
        (
            "initializing",
            FIGURES,
            "**initializing**, frame 7: the map begins when the camera has moved sideways",
        ),
        (MISSING, {}, "**missing**, frame 7: no image could be decoded"),
        (
            "tracking",
            {"tracking/inliers": 0.0, "tracking/tracked": 0.0},
            "**tracking**, frame 7: the image shows nothing",
        ),
        ("tracking", {}, "**tracking**, frame 7"),
    ],
)
def test_the_state_is_said_with_what_it_comes_from(state, scalars, text):
    assert state_text(7, state, scalars) == text
