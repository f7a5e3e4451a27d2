import logging

import pytest

from semcast.channel.silence import Silence


@pytest.fixture
def told(caplog):
    caplog.set_level(logging.INFO, "semcast.channel.silence")
    return lambda: [record.getMessage() for record in caplog.records]


def test_silence_is_told_once_with_who_is_missing(told):
    silence = Silence("left", silence_s=0.0)
    silence.on_alive("server", True)
    silence.check()
    silence.check()
    said = "no frame of agent 'left' has come for 0 s: no agent of this name (another --agent-id?)"
    assert told() == ["server is there", said]
    silence.on_frame()
    silence.on_alive("agent", True)
    silence.check()
    assert told()[2:] == ["agent is there", "no frame of agent 'left' has come for 0 s: it sends none"]


def test_nothing_is_told_before_the_time_is_over(told):
    silence = Silence("left")
    silence.check()
    assert told() == []


def test_who_is_missing_is_not_known_while_the_hub_is_out_of_touch(told):
    silence = Silence("left", silence_s=0.0)
    silence.on_alive("agent", True)
    silence.on_alive("agent", None)
    silence.check()
    assert told() == ["agent is there"]
    silence.on_alive("agent", True)
    silence.on_alive("agent", False)
    assert told()[1:] == ["agent is there", "agent is gone"]


def test_other_channels_are_not_talked_about(told):
    Silence("left").on_alive("channel", True)
    assert told() == []
