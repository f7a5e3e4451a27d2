"""What a server refuses before it begins, and what it takes for the end of a stream."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from announced import announced_camera

from semcast.agent.agent import camera_info
from semcast.agent.settings import AgentSettings
from semcast.agent.source import RecordedSource
from semcast.agent.source_settings import SourceSettings
from semcast.cli import verb_parser
from semcast.commands.running import read_settings
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import CheckpointError, ConfigError, SourceError
from semcast.common.loopback import open_hub
from semcast.common.network_settings import HubSettings
from semcast.common.sequence import open_sequence
from semcast.server.server import Server
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import is_nearly_final
from semcast.server.view.settings import ViewSettings

AGENT = "cam0"
DEMO = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"


@pytest.fixture
def session():
    opened, _ = open_hub()
    yield opened
    opened.close()


def test_a_codec_asked_for_at_the_start_must_exist(session):
    def load(name, modulation):
        raise CheckpointError(f"no weights of {name}")

    with pytest.raises(CheckpointError, match="no weights of nothing"):
        Server(ServerSettings(agent_id=AGENT, codec="nothing"), session, load)


def test_what_cannot_work_is_said_before_the_server_shows_itself(session, tmp_path):
    (tmp_path / "file").write_text("")
    for changes, error, text in (
        ({"reference": tmp_path / "nowhere"}, SourceError, "nowhere"),
        ({"out": tmp_path / "file"}, ConfigError, "folder for outputs"),
        ({"view": ViewSettings(view="file")}, ConfigError, "--out"),
    ):
        with pytest.raises(error, match=text):
            Server(ServerSettings(agent_id=AGENT, bundle="inline", **changes), session)
    assert session.alive_roles(AGENT) == set()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"threads": 0}, r"threads must be in \[1, 1024\], got 0"),
        ({"threads": 100_000}, r"threads must be in \[1, 1024\], got 100000"),
        ({"camera": CameraSettings(focal_35mm=26.0)}, "of the reference, and there is none"),
        ({"checkpoint_interval_s": 0.0}, r"checkpoint_interval_s must be in \[0.1, 3600\]"),
        ({"duration_s": -1.0}, "duration_s must be positive"),
        ({"save_images": "all"}, "save_images needs out"),
        ({"agent_id": "a/b"}, "agent_id must be"),
    ],
)
def test_settings_out_of_range_say_so(changes, text):
    with pytest.raises(ValueError, match=text):
        ServerSettings(**changes)


@pytest.mark.parametrize(
    ("settings", "idle"),
    [
        (ServerSettings(), ""),
        (ServerSettings(view=ViewSettings(view="none")), ""),
        (
            ServerSettings(view=ViewSettings(view="none", web_port=9091, port=9877)),
            "viewer_port, web_port: no effect",
        ),
        (ServerSettings(view=ViewSettings(view="web", web_port=9091, port=9877)), ""),
        (
            ServerSettings(view=ViewSettings(view="file", leave_open=False, jpeg_quality=50)),
            "viewer_leave_open: no",
        ),
        (ServerSettings(checkpoint_interval_s=9.0), "checkpoint_interval_s: no effect"),
        (ServerSettings(checkpoint_interval_s=9.0, out=Path("runs")), ""),
        (ServerSettings(max_age_ms=9.0, mode="replay"), "max_age_ms: no effect in mode replay"),
        (ServerSettings(max_age_ms=9.0), ""),
        (
            ServerSettings(idle_timeout_s=9.0, keep_running=True),
            "idle_timeout_s: no effect with keep_running",
        ),
        (ServerSettings(idle_timeout_s=9.0), ""),
    ],
)
def test_values_that_do_nothing_are_said(settings, idle, caplog):
    settings.warn()
    assert caplog.text.count("no effect") == bool(idle)
    assert idle in caplog.text


def test_the_hub_is_on_loopback_unless_told_otherwise():
    assert HubSettings().listens_on == ("tcp/127.0.0.1:7447",)


def test_a_server_that_connects_to_a_hub_opens_no_port_of_its_own_unasked():
    other, own = "tcp/127.0.0.1:7448", "tcp/127.0.0.1:7449"
    parser = verb_parser("server")
    for words, listen in (([], ()), (["--listen", own], (own,))):
        arguments = parser.parse_args(["--connect", other, *words])
        network = read_settings(ServerSettings, arguments).network
        assert (network.listens_on, network.connect) == (listen, (other,))
    assert read_settings(ServerSettings, parser.parse_args([])).network == HubSettings()


@pytest.mark.parametrize(
    ("num_frames", "last_id", "frame_id", "is_near"),
    [
        (51, 50, 41, True),
        (51, 50, 40, False),
        (13, 48, 44, True),  # every fourth frame of 51
        (13, 48, 40, False),
        (13, 48, 24, False),
        (100, None, 495, False),  # a camera's images are counted as they come
        (None, None, 10**6, False),
    ],
)
def test_the_last_frames_are_known_by_their_ids(num_frames, last_id, frame_id, is_near):
    camera = announced_camera(num_frames=num_frames, last_frame_id=last_id)
    assert is_nearly_final(frame_id, camera) is is_near


def test_the_reference_follows_the_camera_of_a_restarted_agent(session):
    agent = AgentSettings(agent_id=AGENT, source=SourceSettings(source=str(DEMO)))
    codec = SimpleNamespace(name="jpeg-ldpc", digest="", modulation="16qam")
    sequences = [open_sequence(DEMO, resize=resize) for resize in (0.5, 0.25)]
    server = Server(
        ServerSettings(agent_id=AGENT, reference=DEMO, bundle="inline", view=ViewSettings(view="none")),
        session,
    )
    try:
        for epoch, sequence in enumerate(sequences, start=1):
            info = camera_info(agent, RecordedSource(sequence, agent.source), codec, epoch)
            server._sessions.begin(info)
            assert server._sessions._reference.psnr_db(3, sequence.image(3)).result(20) == 100.0
    finally:
        server.close()


@pytest.mark.parametrize("limit", ["1GB", "1.5 GB", "512MiB", "512kB", "50%", "100%"])
def test_a_viewer_may_use_so_much_memory(limit):
    assert ViewSettings(memory_limit=limit).memory_limit == limit


@pytest.mark.parametrize("limit", ["abc", "100", "1gb", "512KB", "200%", ""])
def test_a_viewer_that_would_refuse_its_memory_is_not_begun(limit):
    with pytest.raises(ValueError, match=f"such as 1GB, got '{limit}'"):
        ViewSettings(memory_limit=limit)


@pytest.mark.parametrize("name", ["idle_timeout_s", "duration_s", "max_age_ms"])
def test_a_limit_that_is_no_number_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive, got nan"):
        ServerSettings(**{name: float("nan")})


@pytest.mark.parametrize(
    ("when", "mode", "cores", "at_end"),
    [
        ("auto", "live", 2, True),
        ("auto", "live", 4, False),
        ("auto", "replay", 16, True),
        ("live", "live", 2, False),
        ("end", "live", 16, True),
    ],
)
def test_depth_is_estimated_live_where_there_are_cores_for_it(monkeypatch, when, mode, cores, at_end):
    monkeypatch.setattr("semcast.server.settings.usable_cores", lambda: cores)
    assert ServerSettings(dense_cloud=when, mode=mode).dense_at_end == at_end
