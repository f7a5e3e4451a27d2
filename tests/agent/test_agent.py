"""An agent whose start fails leaves nothing behind in the process."""

import threading

import pytest

from semcast.agent import agent
from semcast.agent.agent import run_agent
from semcast.agent.settings import AgentSettings
from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.errors import CheckpointError, TransportError


class FailingSession:
    """Fails when somebody wants to be seen, or at what is named."""

    def __init__(self, at):
        self.at, self.closed = at, False

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.closed = True

    def _do(self, what):
        if self.at == what:
            raise TransportError("the session is closed")

    def answer(self, key, handle):
        self._do("answer")

    def subscribe(self, key, service, deliver):
        self._do("subscribe")

    def subscribe_keyed(self, key, deliver):
        self._do("subscribe_keyed")

    def publisher(self, key, service):
        self._do("publisher")
        return self

    def put(self, payload):
        pass

    def declare_alive(self, agent_id, role):
        self._do("declare_alive")


@pytest.fixture
def opened(monkeypatch):
    """Sources that were opened, and those of them that were closed."""
    sources, closed = [], []

    def open_and_note(settings):
        source = open_source(settings)
        monkeypatch.setattr(source, "close", lambda: closed.append(source))
        sources.append(source)
        return source

    monkeypatch.setattr(agent, "open_source", open_and_note)
    return sources, closed


@pytest.mark.parametrize("at", ["publisher", "answer", "subscribe", "subscribe_keyed", "declare_alive"])
def test_an_agent_that_fails_to_start_closes_its_source_and_ends_its_threads(
    recording, codec, monkeypatch, opened, at
):
    session = FailingSession(at)
    monkeypatch.setattr(agent, "open_session", lambda network, stop: session)
    before = set(threading.enumerate())
    settings = AgentSettings(source=SourceSettings(source=str(recording)), share_source="jpeg")
    with pytest.raises(TransportError, match="the session is closed"):
        run_agent(settings, threading.Event(), codec)
    sources, closed = opened
    assert closed == sources != []
    assert session.closed
    assert {thread.name for thread in set(threading.enumerate()) - before} == set()


def test_an_agent_that_is_stopped_while_it_waits_does_not_say_that_it_sends(
    recording, codec, monkeypatch, caplog
):
    caplog.set_level("INFO", "semcast")
    monkeypatch.setattr(agent, "open_session", lambda network, stop: FailingSession(None))
    stop = threading.Event()
    stop.set()
    run_agent(AgentSettings(source=SourceSettings(source=str(recording)), wait=False), stop, codec)
    assert "0 frames sent" in caplog.text
    assert "sending" not in caplog.text


@pytest.mark.parametrize(("rate", "told"), [("1/16", "576"), ("auto", "192 to 1152")])
def test_an_agent_says_what_it_takes_of_the_channel(recording, codec, monkeypatch, caplog, rate, told):
    caplog.set_level("INFO", "semcast")
    monkeypatch.setattr(agent, "open_session", lambda network, stop: FailingSession(None))
    settings = AgentSettings(source=SourceSettings(source=str(recording)), wait=False, rate=rate)
    run_agent(settings, threading.Event(), codec)
    assert f"sending steps with tiny, live, {told} channel uses a frame" in caplog.messages


def test_an_agent_without_weights_closes_its_source(recording, tmp_path, opened):
    settings = AgentSettings(
        source=SourceSettings(source=str(recording)), weights=tmp_path / "missing.safetensors"
    )
    with pytest.raises(CheckpointError):
        run_agent(settings, threading.Event())
    assert opened[1] == opened[0] != []
