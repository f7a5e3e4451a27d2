"""What agents say of themselves when they are asked."""

import time

import pytest
from announced import announced_camera

from semcast.common.keys import camera_key
from semcast.common.loopback import open_hub
from semcast.common.wire import pack
from semcast.server.announcement import Announcement, answered_camera

EPOCHS = (3, 5, 8)


def camera(epoch):
    return announced_camera(agent_epoch=epoch)


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


def test_an_agent_that_announced_itself_too_early_to_be_heard_is_asked_when_it_is_there():
    """Between a server's subscription and its question who is there, an agent may have spoken already."""
    hub, _ = open_hub()
    with hub:
        announced = Announcement(hub, "a")
        hub.answer(camera_key("a"), lambda request: pack(camera(3)))
        assert announced.take() is None
        hub.declare_alive("a", "agent")
        until_s = time.monotonic() + 10.0
        while (taken := announced.take()) is None and time.monotonic() < until_s:
            time.sleep(0.01)
        assert taken == camera(3)


def test_of_several_announced_streams_the_newest_is_begun_on(session):
    announced = Announcement(session, "a")
    for epoch in (5, 8, 3):
        session.publisher(camera_key("a"), "every").put(pack(camera(epoch)))
    until_s = time.monotonic() + 10.0
    while not announced.is_newer(5) and time.monotonic() < until_s:
        time.sleep(0.01)
    time.sleep(0.2)  # the oldest comes last
    assert announced.take() == camera(8)
    assert announced.take() is None
