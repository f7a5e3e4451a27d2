import pytest

from semcast.common.camera import Intrinsics
from semcast.server.stream_identity import StreamIdentity

CAMERA = Intrinsics(fx=60, fy=60, cx=47.5, cy=31.5, width=96, height=64)


@pytest.mark.parametrize(
    ("announced", "final_id", "num_frames"),
    [
        ((98, 97, 1), 89, 90),  # a container that promised more than it held
        ((90, 89, 1), 97, 98),  # or less
        ((49, 96, 2), 88, 45),
        ((20, 230, 12), 230, 20),  # ids of images cut out of a recording lie unevenly
        ((None, None, 1), 89, None),
        ((98, None, 1), 89, 98),
    ],
)
def test_the_last_frame_tells_how_many_there_were(announced, final_id, num_frames):
    assert StreamIdentity("a", 5, "x", "", CAMERA, *announced).num_until(final_id) == num_frames
