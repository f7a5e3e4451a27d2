import socket

from semcast.common.reachability import Knocks


def test_what_takes_connections_is_found_and_what_takes_none_is_not():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        knocks = Knocks((f"tls/localhost:{port}#iface=lo",))
        assert knocks.all_can_be_asked
        assert knocks.answering() == f"tls/localhost:{port}#iface=lo"
    assert knocks.answering() is None
    assert knocks.all_can_be_asked


def test_other_protocols_and_names_nobody_knows_are_not_asked():
    knocks = Knocks(("udp/127.0.0.1:7447", "unixsock-stream//tmp/hub"))
    assert not knocks.all_can_be_asked
    assert knocks.answering() is None
    assert knocks.unknown_hosts == ()
    knocks = Knocks((f"tcp/{'a' * 70}:7447",))
    assert knocks.answering() is None
    assert not knocks.all_can_be_asked
    assert knocks.unknown_hosts == ("a" * 70,)
