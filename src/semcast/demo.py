"""The demo: server, channel and agent as three real processes on loopback, until the sequence ends."""

import json
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from semcast.agent.pace_control import start_stride
from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.codec import DEFAULT_CODEC, MODULATION_HELP, Modulation
from semcast.common.codecs import check_codec, is_adaptive, is_conventional, named_weights
from semcast.common.config import to_toml
from semcast.common.config_flags import flag_words
from semcast.common.errors import ConfigError, SemcastError, TransportError
from semcast.common.keys import status_key
from semcast.common.loopback import free_endpoint
from semcast.common.network_settings import NetworkSettings
from semcast.common.playback import check_playback
from semcast.common.rate import NATIVE_RATE, RateChoice
from semcast.common.role import Role
from semcast.common.run_folder import DEMO_SETTINGS_NAME, SUMMARY_NAME
from semcast.common.transport import Session, open_session
from semcast.common.whole_file import check_writable, write_whole
from semcast.demo_recording import DemoRecording, look_at
from semcast.demo_watch import ERROR_CODE, START_DEADLINE_S, Alive, watch
from semcast.real_time import plan_for
from semcast.server.former_run import check_not_foreign, discard, output_folder
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.run_summary import run_line, too_much
from semcast.server.settings import DenseWhen, SavedImages, ServerSettings
from semcast.server.view.settings import ViewChoice, ViewSettings
from semcast.server.viewing import check_viewer

AGENT_ID = "demo"
_PROGRAM = (sys.executable, "-m", "semcast")
#: Warnings of one role that are told at the end.
_MAX_WARNINGS = 3


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """What the demo runs.

    Raises:
        ValueError: A value is out of range.
    """

    sequence: Path | None = field(
        default=None,
        metadata={"help": "recorded sequence or video; without it the sequence shipped with semcast"},
    )
    camera: CameraSettings = field(
        default=CameraSettings(), metadata={"help": "camera of a sequence that does not say it"}
    )
    codec: str = field(
        default=DEFAULT_CODEC, metadata={"help": "codec by name, such as jpeg-ldpc, or file of weights"}
    )
    modulation: Modulation = field(default="16qam", metadata={"help": MODULATION_HELP})
    rate: RateChoice = field(
        default=NATIVE_RATE, metadata={"help": "channel uses per pixel value; auto: as the link needs"}
    )
    link: ChannelSettings = field(default=ChannelSettings(), metadata={"help": "the channel"})
    confidence: Literal["robust", "paper", "off"] = field(
        default="robust", metadata={"help": "how the geometry uses confidence"}
    )
    view: ViewChoice = field(
        default="auto", metadata={"help": "viewer: a window, the browser, only run.rrd, or none"}
    )
    viewer_port: int = field(
        default=ViewSettings.port, metadata={"help": "loopback port the viewer takes the stream on"}
    )
    web_port: int = field(
        default=ViewSettings.web_port, metadata={"help": "loopback port of the web viewer's page"}
    )
    resize: float | None = field(
        default=None,
        metadata={"help": "factor on the image size; by default what this machine can serve"},
    )
    stride: int | None = field(
        default=None,
        metadata={"help": "send every Nth image; by default so many that about 12 a second remain"},
    )
    rate_hz: float | None = field(
        default=None,
        metadata={"help": "images a second; by default as recorded, or as many as this machine can serve"},
    )
    save_images: SavedImages = field(
        default="keyframes", metadata={"help": "decoded images kept in the output folder, for exports"}
    )
    dense_cloud: DenseWhen = field(
        default="auto",
        metadata={
            "help": "depth of keyframes, for dense.ply and the viewer: live, at the end of the stream, auto "
            "(live on four cores or more) or none"
        },
    )
    record: Path | None = field(
        default=None, metadata={"help": "also keep everything that is sent in this recording (MCAP)"}
    )
    seed: int = field(default=0, metadata={"help": "seed of channel and estimation"})
    out: Path = field(default=Path("runs/demo"), metadata={"help": "folder for all outputs"})
    json: Path | None = field(
        default=None, metadata={"help": "also write the summary to this file, - for stdout"}
    )

    def __post_init__(self) -> None:
        """Check what the three processes would only notice after their start."""
        _ = self.view_settings
        ReconstructionSettings(seed=self.seed)
        check_playback(resize=self.resize, stride=self.stride, rate_hz=self.rate_hz)

    @property
    def view_settings(self) -> ViewSettings:
        """The server's viewer."""
        return ViewSettings(view=self.view, port=self.viewer_port, web_port=self.web_port)


def default_sequence() -> Path:
    """Return the demo sequence of the source checkout.

    Raises:
        ConfigError: semcast was installed without its checkout.
    """
    for root in (Path(__file__).resolve().parents[2], Path.cwd()):
        folder = root / "deploy" / "demo" / "kitti_06"
        if folder.is_dir():
            return folder
    raise ConfigError(
        "the demo sequence comes with the source checkout only; name your own with --sequence DIR"
    )


@dataclass(frozen=True)
class Playback:
    """How the agent plays the recording.

    Attributes:
        resize: Factor on the image size.
        stride: One image of so many is sent.
        rate_hz: Images a second that are sent.
        speed: Of the playback against the recording.
    """

    resize: float
    stride: int
    rate_hz: float
    speed: float


def role_commands(settings: DemoSettings, reference: Path | None, endpoint: str) -> dict[str, list[str]]:
    """Return the command lines of server and channel, in the order they are started."""
    server = [*_PROGRAM, "server", "--agent-id", AGENT_ID, "--listen", endpoint, "--out", str(settings.out)]
    if reference is not None:
        server += ["--reference", str(reference), *flag_words(settings.camera)]
    server += ["--confidence", settings.confidence]
    server += flag_words(settings.view_settings, ("view",))
    server += ["--seed", str(settings.seed), *_codec_words(settings)]
    server += ["--save-images", settings.save_images]
    server += ["--dense-cloud", settings.dense_cloud]
    if settings.record is not None:
        server += ["--record", str(settings.record)]
    channel = [*_PROGRAM, "channel", "--agent-id", AGENT_ID, "--connect", endpoint]
    channel += [*flag_words(settings.link, ("channel", "snr_db")), "--seed", str(settings.seed)]
    return {"server": server, "channel": channel}


def _codec_words(settings: DemoSettings) -> list[str]:
    """Return codec and modulation, which does nothing with a codec that chooses its own."""
    modulation = [] if is_adaptive(settings.codec) else ["--modulation", settings.modulation]
    return ["--codec", settings.codec, *modulation]


def agent_command(settings: DemoSettings, sequence: Path, endpoint: str, playback: Playback) -> list[str]:
    """Return the command line of the agent, which is started last."""
    agent = [*_PROGRAM, "agent", "--agent-id", AGENT_ID, "--connect", endpoint]
    agent += ["--source", str(sequence), *flag_words(settings.camera)]
    agent += [*_codec_words(settings), "--rate", settings.rate]
    agent += ["--resize", f"{playback.resize:g}", "--stride", str(playback.stride)]
    if playback.speed != 1.0:
        agent += ["--pace", "rate", "--rate-hz", f"{playback.rate_hz:.3g}"]
    return agent


def open_recording(settings: DemoSettings) -> DemoRecording:
    """Open what the demo plays.

    Raises:
        SemcastError: It can't be read, or its camera is unknown.
    """
    return look_at(settings.sequence or default_sequence(), settings.camera)


def run_demo(
    settings: DemoSettings,
    recorded: DemoRecording,
    stop: threading.Event,
    tell: Callable[[str], None],
    progress: Callable[[int, str], None],
) -> tuple[dict[str, Any] | None, str | None]:
    """Run the three processes until the server has written its summary, or until ``stop``.

    A process that is killed does not end the demo: its command line is told, so that it can be started again
    by hand, and the stream goes on when it is. One that gives up does: its source or disk would fail again.

    Args:
        settings: What to run.
        recorded: What they play.
        stop: Ends the run early; outputs are still written.
        tell: Takes one line of text for the user.
        progress: Takes the number of images that are done with, and how it stands in words.

    Returns:
        The server's summary, or None when it never wrote one, and what ended the run early, or None.

    Raises:
        SemcastError: The codec can't be used, or a process could not be started.
    """
    logs = _prepare(settings)
    if doubt := recorded.doubt:
        tell(f"{recorded.name} is {doubt}")
    summary_file = settings.out / SUMMARY_NAME
    endpoint = free_endpoint()
    commands = role_commands(settings, None if recorded.is_video else recorded.path, endpoint)
    children = {name: Role(name, command, logs / f"{name}.log") for name, command in commands.items()}
    alive = Alive(set(), threading.Condition())
    try:
        children["server"].start()
        session = _join(endpoint, children["server"], stop)
        if session is None:
            return None, None
        with session:
            session.watch_alive(AGENT_ID, alive.on_change)
            for role in ("agent", "server"):
                session.subscribe(status_key(AGENT_ID, role), "newest", alive.on_status)
            children["channel"].start()
            playback = choose_playback(settings, recorded, stop)
            if playback is None:
                return None, None
            for text in _reductions(settings, playback, recorded.num_frames):
                tell(text)
            command = agent_command(settings, recorded.path, endpoint, playback)
            children["agent"] = Role("agent", command, logs / "agent.log")
            _bring_up(children, alive, stop, tell)
            error = watch(settings.out, children, alive, stop, tell, progress)
            _keep_settings(settings, recorded.path, playback, tell)
            children["agent"].stop()  # what it says last counts
            if left_out := alive.num_unreadable:
                where = children["agent"].log
                tell(f"images left out, unreadable or of another size: {left_out}, see {where}")
    finally:
        for child in reversed(children.values()):
            child.stop()
    summary = json.loads(summary_file.read_text(encoding="utf-8")) if summary_file.exists() else None
    # Warnings that the table, or the line below it, says.
    known = [run_line(summary), too_much(summary)] if summary else []
    for name in ("agent", "server"):
        if name in children:
            for text in _warnings(children[name], known):
                tell(f"the {name} warns: {text}")
    if error is None and children["server"].returncode == ERROR_CODE:
        error = f"the server: {children['server'].last_words()}"  # its outputs are there, not its recording
    return summary, error


def _warnings(role: Role, known: Sequence[str | None]) -> list[str]:
    """Return the first few unknown warnings of a role, and how many more: one image each may be damaged."""
    told = [text for text in role.warnings() if text not in known]
    more = len(told) - _MAX_WARNINGS
    return told if more <= 0 else [*told[:_MAX_WARNINGS], f"{more} times more, see {role.log}"]


def _prepare(settings: DemoSettings) -> Path:
    """Look at all that can be wrong before anything of a former run goes, and return a folder for logs.

    Raises:
        SemcastError: Something is wrong.
    """
    check_codec(settings.codec)
    named_weights(settings.codec)
    check_viewer(ServerSettings(out=settings.out, view=settings.view_settings))
    Link(settings.link, settings.seed)  # reads a trace
    for name, file in (("record", settings.record), ("json", settings.json)):
        if file is not None:
            check_writable(file, name)
    logs = settings.out / "logs"
    # The server takes the folder for itself as soon as it starts.
    with output_folder(settings.out):
        check_not_foreign(settings.out, SUMMARY_NAME)
        try:
            logs.mkdir(exist_ok=True)
        except OSError as err:
            raise ConfigError(f"{logs} can't be made a folder for logs: {err}") from err
        discard(settings.out)
    return logs


def _bring_up(
    children: Mapping[str, Role], alive: Alive, stop: threading.Event, tell: Callable[[str], None]
) -> None:
    """Start the agent once server and channel are there, and tell the command line of each."""
    for name, child in children.items():
        if name == "agent":
            child.start()
        alive.wait_for(name, child, stop)
        tell(f"{name} is up: {shlex.join(child.command)}")


def _keep_settings(
    settings: DemoSettings, sequence: Path, playback: Playback, tell: Callable[[str], None]
) -> None:
    """Write what was in force beside the results: the server's settings know nothing of agent and link."""
    in_force = replace(
        settings,
        sequence=sequence,
        resize=playback.resize,
        stride=playback.stride,
        rate_hz=playback.rate_hz,
    )
    file = settings.out / DEMO_SETTINGS_NAME
    try:
        write_whole(file, to_toml(in_force))
    except OSError as err:
        tell(f"{file} can't be written: {err}")


def _join(endpoint: str, server: Role, stop: threading.Event) -> Session | None:
    """Connect to the server, which is the hub; None when ``stop`` was set before.

    Raises:
        SemcastError: Its process ended, or the deadline passed.
    """
    deadline_s = time.monotonic() + START_DEADLINE_S
    while True:
        try:
            return open_session(NetworkSettings(connect=(endpoint,)), stop, deadline_s=1.0)
        except TransportError as err:
            if server.returncode is not None:
                raise SemcastError(f"server did not start: {server.last_words()}") from err
            if time.monotonic() > deadline_s:
                raise


def choose_playback(
    settings: DemoSettings, recorded: DemoRecording, stop: threading.Event | None = None
) -> Playback | None:
    """Return how the recording is played: as asked for, and the rest as this machine can serve it.

    None when ``stop`` was set before that was measured.

    Raises:
        ConfigError: The codec is unknown.
        CheckpointError: Its weights are missing or damaged.
    """
    stride = settings.stride or start_stride(recorded.rate_hz)
    full_hz = recorded.rate_hz / stride
    rate_hz = settings.rate_hz or full_hz
    if settings.resize is not None and settings.rate_hz is not None:
        return Playback(settings.resize, stride, rate_hz, rate_hz / full_hz)
    plan = plan_for(
        settings.codec,
        settings.modulation,
        recorded.image,
        rate_hz,
        settings.rate,
        settings.resize,
        stop,
        settings.link.snr_db,
    )
    if plan is None:
        return None
    rate_hz = settings.rate_hz or plan.rate_hz
    return Playback(plan.resize, stride, rate_hz, rate_hz / full_hz)


def _reductions(settings: DemoSettings, playback: Playback, num_frames: int | None) -> Iterator[str]:
    """Yield in words what was done, unasked, for this machine to keep up.

    Args:
        settings: What was asked for.
        playback: What is done.
        num_frames: Images of the recording; None where a video does not say.
    """
    if settings.stride is None and playback.stride > 1:
        yield f"one image in {playback.stride} is sent; --stride 1 sends all"
    if settings.resize is None and playback.resize < 1.0:
        yield f"images are sent at {playback.resize:g} of their size; --resize 1 sends them as they are"
    if settings.rate_hz is None and playback.speed < 1.0:
        takes = ""
        if num_frames is not None:
            takes = f", which takes {_duration(num_frames / playback.stride / playback.rate_hz)}"
        pace = f"played at {playback.speed:.2g} of the recorded pace{takes}"
        yield f"{pace}, as this machine can serve{_faster(settings)}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 99.5 else f"{seconds / 60:.0f} min"


def _faster(settings: DemoSettings) -> str:
    """Say what takes less time on a slow machine."""
    other = "" if is_conventional(settings.codec) else ", or a conventional codec such as jpeg-amc"
    return f"; faster with a smaller --resize{other}, or at any pace with --rate-hz, where images are skipped"
