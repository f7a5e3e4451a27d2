import pytest

from semcast.server.mapping.keyframe_rule import KeyframeCues, wants_keyframe


def cues(**changes):
    values = {
        "num_inliers": 200,
        "num_inliers_at_keyframe": 220,
        "num_visible": 450,
        "max_features": 500,
        "median_flow_px": 10.0,
        "width_px": 640,
        "frames_since": 3,
        "usable_share": 1.0,
    }
    return KeyframeCues(**{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({}, False),
        ({"median_flow_px": 40.0}, True),
        ({"num_inliers": 150}, True),
        ({"num_inliers": 150, "frames_since": 1}, False),
        ({"num_visible": 200}, True),
        ({"num_inliers": 30}, True),
        ({"num_inliers": 30, "median_flow_px": 0.5}, False),
        ({"median_flow_px": 40.0, "usable_share": 0.3}, False),
        ({"num_inliers": 30, "usable_share": 0.3, "frames_since": 6}, True),
    ],
)
def test_the_keyframe_rule(changes, wanted):
    assert wants_keyframe(cues(**changes)) is wanted


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"median_flow_px": 40.0}, True),
        ({"num_inliers": 60}, False),  # it is the image that is bad
        ({"num_inliers": 30, "median_flow_px": 40.0}, False),  # who knows whether that pose is true
        ({"num_inliers": 60, "median_flow_px": 40.0, "usable_share": 0.4, "frames_since": 6}, True),
        ({"num_inliers": 60, "median_flow_px": 40.0, "usable_share": 0.4}, False),
    ],
)
def test_in_an_outage_only_another_view_makes_a_keyframe(changes, wanted):
    assert wants_keyframe(cues(**changes), is_in_outage=True) is wanted
