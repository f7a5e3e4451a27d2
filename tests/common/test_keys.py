import pytest

from semcast.common import keys


def test_keys_are_those_of_the_table():
    assert keys.camera_key("a1") == "semcast/a1/camera"
    assert keys.tx_key("a1") == "semcast/a1/tx/symbols"
    assert keys.rx_key("a1") == "semcast/a1/rx/symbols"
    assert keys.link_key("a1") == "semcast/a1/link"
    assert keys.flow_key("a1") == "semcast/a1/flow"
    assert keys.channel_key("a1") == "semcast/a1/channel"
    assert keys.pose_key("a1") == "semcast/a1/pose"
    assert keys.metric_pose_key("a1") == "semcast/a1/metric_pose"
    assert keys.map_key("a1") == "semcast/a1/map"
    assert keys.status_key("a1", "server") == "semcast/a1/status/server"
    assert keys.control_key("a1", "channel") == "semcast/a1/control/channel"
    assert keys.all_keys("a1") == "semcast/a1/**"


def test_role_and_agent_come_back_out_of_a_key():
    key = keys.alive_key("cam-0_b", "channel")
    assert (keys.agent_of(key), keys.role_of(key)) == ("cam-0_b", "channel")


@pytest.mark.parametrize("key", ["", "camera", "semcast/cam0", "/front camera/image", "semcast//camera"])
def test_a_key_of_somebody_else_names_no_agent(key):
    assert keys.agent_of(key) == ""


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "-a", "x" * 65, "ä", "a\n"])
def test_names_that_would_change_the_key_are_refused(name):
    with pytest.raises(ValueError, match="agent_id must be"):
        keys.tx_key(name)


def test_unknown_roles_are_refused():
    with pytest.raises(ValueError, match="role must be one of agent, channel, server, got 'spy'"):
        keys.alive_key("a", "spy")
