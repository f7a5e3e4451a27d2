"""How the tracker stands after a frame, in a line of Markdown for people who watch."""

from collections.abc import Mapping

from semcast.server.mapping.state import TrackingState
from semcast.server.view.frame_view import MISSING


def state_text(frame_id: int, state: str, scalars: Mapping[str, float]) -> str:
    """Return the line of one frame.

    Args:
        frame_id: Index of the frame in its source.
        state: Tracking state in words, or ``MISSING``.
        scalars: Plot path to value, as in ``FrameView``.
    """
    what = _what(state, scalars)
    return f"**{state}**, frame {frame_id}{': ' if what else ''}{what}"


def _what(state: str, scalars: Mapping[str, float]) -> str:
    if state == MISSING:
        return "no image could be decoded"
    if state == TrackingState.INITIALIZING.value:
        return "the map begins when the camera has moved sideways"
    if "tracking/inliers" not in scalars:
        return ""
    num_inliers, num_tracked = scalars["tracking/inliers"], scalars["tracking/tracked"]
    if not num_tracked and state == TrackingState.TRACKING.value:
        return "the image shows nothing"
    enough = ", too few" if state == TrackingState.LOST.value else ""
    return f"{num_inliers:.0f} of {num_tracked:.0f} keypoints agree with the map{enough}"
