"""What agents say of themselves when they are asked."""

import pytest

from semcast.common.keys import camera_key
from semcast.common.loopback import open_hub
from semcast.common.messages import CameraInfo
from semcast.common.wire import pack
from semcast.server.announcement import answered_camera

EPOCHS = (3, 5, 8)


def camera(epoch):
    return CameraInfo(
        agent_id="a",
        agent_epoch=epoch,
        fx=100.0,
        fy=100.0,
        cx=31.5,
        cy=23.5,
        image_wh=(64, 48),
        nominal_rate_hz=10.0,
        codec="phase",
        digest="",
        modulation="16qam",
        source_name="room",
        num_frames=None,
        lossless=False,
    )


@pytest.fixture
def session():
    """A session on which agents of one name answer, and something that answers nonsense."""
    hub, _ = open_hub()
    with hub:
        for answer in (b"nonsense", *(pack(camera(epoch)) for epoch in EPOCHS)):
            hub.answer(camera_key("a"), lambda request, answer=answer: answer)
        yield hub


def test_each_of_several_agents_of_one_name_answers_for_itself(session):
    assert [answered_camera(session, "a", epoch, 5.0) for epoch in EPOCHS] == [camera(e) for e in EPOCHS]
    assert answered_camera(session, "a", None, 5.0).agent_epoch in EPOCHS
    assert answered_camera(session, "b", None, 5.0) is None, "nobody has that name"
