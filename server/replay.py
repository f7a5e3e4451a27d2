"""Replays a recording through the same decoder, tracker and outputs as the live server, without a network."""

import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.codec import PRECISION_HELP, Precision
from semcast.common.cores import check_threads
from semcast.common.errors import SemcastError, SourceError
from semcast.common.messages import SymbolFrame
from semcast.common.phy.equaliser import Equalised
from semcast.common.phy.pilots import insert_pilots
from semcast.common.playback import check_part
from semcast.common.rate import belongs_to
from semcast.common.recorded_streams import RecordedStream, Symbols, choose_stream, stream_messages
from semcast.common.recording_reader import RecordingReader
from semcast.common.symbol_payload import encoded_image, equalise_frame
from semcast.server.conclusion import conclude
from semcast.server.decoder import Arrival, FrameDecoder, codec_loader
from semcast.server.former_run import output_folder
from semcast.server.frame_views import missing_view
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.marker_settings import MarkerSettings
from semcast.server.receiver import ReceivedFrame
from semcast.server.recorded_order import in_order
from semcast.server.reference import recording_reference, sequence_reference
from semcast.server.session import Session
from semcast.server.settings import DenseWhen, SavedImages, ServerSettings, check_save_images
from semcast.server.stream_identity import StreamIdentity
from semcast.server.view.settings import ViewSettings
from semcast.server.viewing import check_viewer, open_viewer

if TYPE_CHECKING:
    from semcast.server.view.feed import ViewerFeed

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """How a recording is replayed: lossless and repeatable to the bit, at any pace.

    Raises:
        ValueError: A value is out of range.
    """

    file: Path = field(metadata={"help": "recording to replay (MCAP)", "positional": True})
    symbols: Symbols | None = field(
        default=None,
        metadata={
            "help": "received: what the recorded link made of the frames (default); "
            "transmitted: what the agent sent, through the channel given here (default when one is given)"
        },
    )
    link: ChannelSettings = field(
        default=ChannelSettings(), metadata={"help": "the channel for transmitted symbols"}
    )
    seed: int = field(default=0, metadata={"help": "seed of channel and estimation"})
    stream: int | None = field(
        default=None,
        metadata={
            "help": "which start of an agent, counted from 1; semcast info lists them (default the last one "
            "that has frames)"
        },
    )
    out: Path | None = field(default=None, metadata={"help": "folder for trajectory, map, summary"})
    save_images: SavedImages = field(
        default="none", metadata={"help": "decoded images kept in the output folder, for exports"}
    )
    dense_cloud: DenseWhen = field(
        default="auto",
        metadata={
            "help": "depth of keyframes, for dense.ply and the viewer: live, end, auto (which is end) or none"
        },
    )
    reference: Path | None = field(
        default=None,
        metadata={
            "help": "recorded sequence the agent sent: gives PSNR and ground truth; without it PSNR comes "
            "from originals in the recording (agent --share-source)"
        },
    )
    camera: CameraSettings = field(
        default=CameraSettings(), metadata={"help": "camera of the reference, where it does not say it"}
    )
    pace: float = field(
        default=0.0,
        metadata={"help": "1: as recorded, 2: twice as fast; 0: as fast as this machine goes"},
    )
    weights: Path | None = field(
        default=None, metadata={"help": "weights of the recorded agent, where they are not the shipped ones"}
    )
    threads: int = field(default=1, metadata={"help": "CPU threads of the decoder"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    start_s: float = field(default=0.0, metadata={"help": "leave out frames before this time of the source"})
    end_s: float | None = field(default=None, metadata={"help": "leave out frames after this time"})
    marker: MarkerSettings = field(default=MarkerSettings(), metadata={"help": "marker that tells the metre"})
    reconstruction: ReconstructionSettings = field(
        default=ReconstructionSettings(), metadata={"help": "tracking and mapping"}
    )

    view: ViewSettings = field(default=ViewSettings(view="none"), metadata={"help": "viewer"})

    def __post_init__(self) -> None:
        if self.symbols == "received" and self.link != ChannelSettings():
            raise ValueError(
                "symbols must be transmitted for another channel, got received: they have been through one"
            )
        if not 0.0 <= self.pace <= 100.0:
            raise ValueError(f"pace must be in [0, 100], got {self.pace:g}")
        check_threads(self.threads)
        replace(self.reconstruction, seed=self.seed)  # which has the narrower range of the two
        self.camera.check_has(self.reference)
        check_save_images(self.save_images, self.out)
        check_part(self.start_s, self.end_s)

    @property
    def source(self) -> Symbols:
        """Which symbols are replayed."""
        if self.symbols is not None:
            return self.symbols
        return "received" if self.link == ChannelSettings() else "transmitted"


def replay(
    settings: ReplaySettings,
    stop: threading.Event | None = None,
    on_frame: Callable[[int], None] | None = None,
    on_activity: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Replay one stream of a recording: the one asked for, else the last that has frames.

    Args:
        settings: What and how.
        stop: Ends early; outputs are still written.
        on_frame: Is told the id of each frame that was processed.
        on_activity: Is told what is going on after the last one.

    Returns:
        The summary, which is also in ``summary.json`` of ``settings.out``.

    Raises:
        SourceError: The file is no recording, or holds no frames of the kind asked for.
        ConfigError: The folder for outputs can't be used, or another run is writing into it.
        CheckpointError: The recorded stream was encoded with other weights than those installed.
    """
    seeded = replace(settings.reconstruction, seed=settings.seed)
    # What is kept of them names the symbols: those that went through no channel here have a link there, too.
    settings = replace(settings, symbols=settings.source, reconstruction=seeded)
    reader = RecordingReader(settings.file)
    stream = choose_stream(reader, settings.stream, settings.source)
    server = ServerSettings(
        agent_id=stream.agent_id,
        mode="replay",
        out=settings.out,
        save_images=settings.save_images,
        dense_cloud=settings.dense_cloud,
        threads=settings.threads,
        reference=settings.reference,
        bundle="inline",
        resume=False,
        marker=settings.marker,
        reconstruction=settings.reconstruction,
        view=settings.view,
    )
    check_viewer(server)
    server.warn()
    with output_folder(settings.out):
        return _replayed(settings, server, reader, stream, stop or threading.Event(), on_frame, on_activity)


def _replayed(
    settings: ReplaySettings,
    server: ServerSettings,
    reader: RecordingReader,
    stream: RecordedStream,
    stop: threading.Event,
    on_frame: Callable[[int], None] | None,
    on_activity: Callable[[str], None] | None,
) -> dict[str, Any]:
    """Decode and reconstruct the frames of a stream; return the summary."""
    agent_id, camera = stream.agent_id, stream.camera
    decoder = FrameDecoder(
        codec_loader(settings.threads, weights=settings.weights, precision=settings.precision)
    )
    # Before a former run is set aside.
    decoder.codec_for(camera.codec, camera.modulation, camera.digest)
    identity = StreamIdentity.of(agent_id, camera)
    reference = (
        sequence_reference(settings.reference, camera.intrinsics, settings.camera)
        if settings.reference is not None
        else recording_reference(reader, stream)
    )
    arrivals = _arrivals(reader, stream, settings)
    # Before a former run is set aside, too.
    first = next(arrivals, None)
    if first is None:
        raise SourceError(_none_in_part(reader, stream, settings))
    drops: dict[str, int] = {}
    processed = 0
    with contextlib.ExitStack() as stack:
        if reference is not None:
            stack.callback(reference.close)
        session = stack.enter_context(
            contextlib.closing(Session(server, identity, settings.out, reference, program=settings))
        )
        viewer = open_viewer(server, identity, reference)
        if viewer is not None:
            stack.callback(viewer.close, leave_window=settings.view.leave_open)
        for arrival in _paced(itertools.chain([first], arrivals), settings.pace, stop):
            if stop.is_set():
                break
            if _take(session, decoder, arrival, viewer, drops):
                processed += 1
                if on_frame is not None:
                    on_frame(arrival.message.frame_id)
        if not processed and not stop.is_set():
            raise SourceError(f"{settings.file} holds no {settings.source} frames that can be decoded")
        return _concluded(settings, session, viewer, drops, on_activity, stop)


def _concluded(
    settings: ReplaySettings,
    session: Session,
    viewer: "ViewerFeed | None",
    drops: dict[str, int],
    on_activity: Callable[[str], None] | None,
    stop: threading.Event,
) -> dict[str, Any]:
    """Adjust the whole map, write what the replay leaves behind and return the summary."""
    stopped = stop.is_set()  # later on only what is left of the depth is missing
    with contextlib.suppress(OSError):  # said at the end
        session.write_results(settings.out)  # who stops the replay may not wait for the adjustment
    conclude(
        session,
        lambda update, patches: viewer.submit(None, update, patches) if viewer is not None else None,
        on_activity or (lambda text: None),
        0.0 if stopped else None,
        is_stopped=stop.is_set,
    )
    try:
        whole = settings.start_s == 0.0 and settings.end_s is None and not stopped
        return session.write_outputs(settings.out, drops, complete=whole)
    except OSError as err:
        raise SemcastError(f"outputs can't be written to {settings.out}: {err}") from err


def _take(
    session: Session,
    decoder: FrameDecoder,
    arrival: ReceivedFrame,
    viewer: "ViewerFeed | None",
    drops: dict[str, int],
) -> bool:
    """Decode, track and show one frame, and tell whether it was tracked; one that is not is counted."""
    message = arrival.message
    session.note_arrival(message.frame_id, message.seq, final=message.final)
    try:
        decoded = decoder.decode(arrival)
    except SemcastError as err:
        logger.warning("frame %d is left out: %s", message.frame_id, err)
        drops["codec"] = drops.get("codec", 0) + 1
        return False
    if decoded.frame is None:
        reason = "lost_on_air" if arrival.received is None else "outage"
        drops[reason] = drops.get(reason, 0) + 1
        if viewer is not None:
            viewer.submit(missing_view(decoded, drops))
        return False
    try:
        outcome = session.process(decoded.frame, Arrival.of(decoded, drops))
    except Exception:  # as a live server would
        logger.exception("frame %d could not be tracked and is left out", message.frame_id)
        drops["track"] = drops.get("track", 0) + 1
        return False
    if viewer is not None:
        viewer.submit(outcome.view, outcome.update, outcome.patches)
    return True


def _none_in_part(reader: RecordingReader, stream: RecordedStream, settings: ReplaySettings) -> str:
    """Say that no frame lies between ``start_s`` and ``end_s``, and how long the stream is."""
    last_s = max((t_s for t_s, _ in _frames(reader, stream, settings)), default=None)
    if last_s is None:
        return f"{settings.file} holds no {settings.source} frames that can be read"
    end = "" if settings.end_s is None else f" and before {settings.end_s:g} s"
    return f"no frame of {settings.file} lies after {settings.start_s:g} s{end}: it is {last_s:.1f} s long"


def _frames(
    reader: RecordingReader, stream: RecordedStream, settings: ReplaySettings
) -> Iterator[tuple[float, SymbolFrame]]:
    """Yield the frames of the stream in order, each once, with its time in seconds since the first one."""
    first_ns = None
    for frame in in_order(_recorded(reader, stream, settings), lambda frame: frame.frame_id):
        first_ns = frame.t_source_ns if first_ns is None else first_ns
        yield (frame.t_source_ns - first_ns) * 1e-9, frame


def _recorded(
    reader: RecordingReader, stream: RecordedStream, settings: ReplaySettings
) -> Iterator[SymbolFrame]:
    """Yield the frames of the stream as they were recorded; those that can't be read are told."""
    direction = "rx" if settings.source == "received" else "tx"
    for _, frame in stream_messages(reader, stream, {"symbols": SymbolFrame}):
        if frame.direction != direction:
            continue
        if frame.payload_format != "lost" and not belongs_to(
            frame.image_hw, stream.camera.intrinsics.shape_hw
        ):
            logger.warning(
                "frame %d of %s is left out: %s is no coded size of its camera",
                frame.frame_id,
                reader.path,
                frame.image_hw,
            )
            continue
        yield frame


def _arrivals(
    reader: RecordingReader, stream: RecordedStream, settings: ReplaySettings
) -> Iterator[ReceivedFrame]:
    """Yield the frames that are replayed, as they arrive."""
    link = Link(settings.link, settings.seed) if settings.source == "transmitted" else None
    for t_s, frame in _frames(reader, stream, settings):
        if t_s < settings.start_s or (settings.end_s is not None and t_s > settings.end_s):
            continue
        try:
            equalised, equalise_ms, snr_db_set = _on_the_air(frame, link, t_s)
        except ValueError as err:  # symbols that a channel process leaves out as well
            logger.warning("frame %d of %s is left out: %s", frame.frame_id, reader.path, err)
            continue
        yield ReceivedFrame(
            message=frame,
            camera=stream.camera,
            received=None if equalised is None else equalised.received,
            snr_db=None if equalised is None else float(equalised.snr_db),
            snr_db_set=snr_db_set,
            t_arrival_ns=time.perf_counter_ns(),
            equalise_ms=equalise_ms,
        )


def _paced(arrivals: Iterator[ReceivedFrame], pace: float, stop: threading.Event) -> Iterator[ReceivedFrame]:
    """Hold every frame back until its recorded time, sped up by ``pace``; 0 holds nothing back."""
    first_ns: int | None = None
    started_s = time.monotonic()
    for arrival in arrivals:
        if pace > 0.0:
            first_ns = arrival.message.t_source_ns if first_ns is None else first_ns
            due_s = started_s + (arrival.message.t_source_ns - first_ns) * 1e-9 / pace
            stop.wait(max(0.0, due_s - time.monotonic()))
        yield replace(arrival, t_arrival_ns=time.perf_counter_ns())


def _on_the_air(
    frame: SymbolFrame, link: Link | None, t_s: float
) -> tuple[Equalised | None, float, float | None]:
    """Return a frame behind the equaliser, None when it is lost; how long that took, in ms; the SNR set."""
    snr_db_set: float | None = None
    if link is None:
        lost, receive = frame.payload_format == "lost", partial(equalise_frame, frame)
    else:
        encoded = encoded_image(frame)
        sent = link.transmit(insert_pilots(encoded.symbols), t_s, frame.frame_id)
        lost, receive, snr_db_set = sent.frame_lost, partial(sent.equalise, encoded), sent.snr_db_set
    if lost:
        return None, 0.0, snr_db_set
    started_ns = time.perf_counter_ns()
    equalised = receive()
    return equalised, (time.perf_counter_ns() - started_ns) * 1e-6, snr_db_set
