"""Everything that travels between the processes, as frozen dataclasses.

Each field carries its check (see ``message_fields``); ``wire`` applies them in both directions, and the ones
across fields in ``consistent``. Times: ``t_capture_ns`` is the agent's monotonic clock and means nothing on
another host without an offset; ``t_source_ns`` is the recorded time, equal to it for live cameras.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import MAX_READOUT_MS, Intrinsics, ReadoutFrom
from semcast.common.codec import MODULATIONS, Modulation
from semcast.common.message_fields import (
    MAX_COUNT,
    Array,
    Bytes,
    Choice,
    FieldError,
    Flag,
    Many,
    Maybe,
    Named,
    Number,
    Setting,
    Text,
    WholeNumber,
    rule,
)
from semcast.common.phy.allocation import Allocation
from semcast.common.phy.slots import BLOCK_PX, USES_PER_BLOCK, SlotLayout, layout_for

PROTOCOL_VERSION = 1
MAX_PAYLOAD_BYTES = 16 * 1024**2
#: A sample as it travels: float16 I and Q.
IQ_BYTES = 4
MAX_SIDE_PX = 8192
#: Five bits for each block of the largest image.
_MAX_ALLOCATION_BYTES = 5 * (MAX_SIDE_PX // BLOCK_PX) ** 2 // 8
#: Keyframes of a day and more: all there ever were, also those that were thinned out since.
MAX_KEYFRAMES = 200_000
#: Frames that may be missing between two that arrive: a number further ahead is not believed at once.
MAX_MISSING = 1000
ROLES = ("agent", "channel", "server")
TRACKING_STATES = ("initializing", "tracking", "lost")

PayloadFormat = Literal["qam16", "qam16_shaped", "iq16", "lost"]
PAYLOAD_FORMATS: tuple[PayloadFormat, ...] = get_args(PayloadFormat)
AGENT_ID_PATTERN = "[A-Za-z0-9][A-Za-z0-9_-]{0,63}"

_VERSION = rule(WholeNumber(PROTOCOL_VERSION, PROTOCOL_VERSION))
_AGENT_ID = rule(Text(64, AGENT_ID_PATTERN))
_COUNT = rule(WholeNumber())
#: Receivers answer with the number of the next frame, which has to fit as well.
_SEQ = rule(WholeNumber(0, MAX_COUNT - 1))
_TIME_NS = rule(WholeNumber(-(2**63)))
_NAME = rule(Text(64, "[A-Za-z0-9_.+-]{1,64}"))
_DIGEST = rule(Text(64, "[0-9a-f]{0,64}"))
_SIZE = rule(Many(WholeNumber(1, MAX_SIDE_PX), count=2))
_PIXELS = rule(Number(-1e5, 1e5))
_FOCAL_PX = rule(Number(1e-3, 1e6))
_DB = rule(Number(-100.0, 100.0))


def received_bytes(layout: SlotLayout) -> int:
    """Return the payload of a frame behind the channel: all samples of the grid, pilots included."""
    return IQ_BYTES * layout.num_uses


def _kind(name: str) -> Any:
    return field(default=name, metadata=rule(Choice((name,))))


@dataclass(frozen=True, kw_only=True)
class _Versioned:
    """What is first in every message, before its kind."""

    version: int = field(default=PROTOCOL_VERSION, metadata=_VERSION)


@dataclass(frozen=True, kw_only=True)
class CameraInfo(_Versioned):
    """What a receiver must know before the first frame; the decoded images are undistorted.

    Attributes:
        agent_id: Name of the agent.
        agent_epoch: Wall time of the agent's start in ns; a restart is a new, higher one.
        fx: Focal length in pixels, of the images sent.
        fy: Focal length in pixels.
        cx: Principal point in pixels.
        cy: Principal point in pixels.
        image_wh: Width and height in pixels.
        nominal_rate_hz: Frames per second the agent aims at; 0 where it has no rate of its own.
        codec: Codec name.
        digest: Its digest.
        modulation: How symbols travel.
        source_name: What the frames come from, for people.
        num_frames: Frames of a finite source, or None.
        last_frame_id: Of its last frame, or None where that is not known.
        lossless: Replay service (every frame, in order) instead of live (newest wins).
        readout_ms: Time a rolling shutter takes from the first row (or column) to the last; 0: a global one.
        readout_from: Side of the image it begins at.
    """

    kind: str = _kind("camera")
    agent_id: str = field(metadata=_AGENT_ID)
    agent_epoch: int = field(metadata=_COUNT)
    fx: float = field(metadata=_FOCAL_PX)
    fy: float = field(metadata=_FOCAL_PX)
    cx: float = field(metadata=_PIXELS)
    cy: float = field(metadata=_PIXELS)
    image_wh: tuple[int, int] = field(metadata=_SIZE)
    nominal_rate_hz: float = field(metadata=rule(Number(0.0, 10000.0)))
    codec: str = field(metadata=_NAME)
    digest: str = field(metadata=_DIGEST)
    modulation: Modulation = field(metadata=rule(Choice(MODULATIONS)))
    source_name: str = field(metadata=rule(Text(200)))
    num_frames: int | None = field(metadata=rule(Maybe(WholeNumber())))
    last_frame_id: int | None = field(default=None, metadata=rule(Maybe(WholeNumber())))
    lossless: bool = field(metadata=rule(Flag()))
    readout_ms: float = field(default=0.0, metadata=rule(Number(0.0, MAX_READOUT_MS)))
    readout_from: ReadoutFrom = field(default="top", metadata=rule(Choice(get_args(ReadoutFrom))))

    @property
    def intrinsics(self) -> Intrinsics:
        """Pinhole of the decoded images."""
        width, height = self.image_wh
        return Intrinsics(
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            width=width,
            height=height,
            readout_ms=self.readout_ms,
            readout_from=self.readout_from,
        )

    @property
    def frame_step(self) -> int:
        """Usual difference of the ids of two frames that follow each other; 1 where it is not known."""
        return max(1, (self.last_frame_id or 0) // max(1, (self.num_frames or 0) - 1))


@dataclass(frozen=True, kw_only=True)
class SymbolFrame(_Versioned):
    """Channel symbols of one frame, before (``tx``) or behind (``rx``) the channel.

    Attributes:
        agent_epoch: See ``CameraInfo``.
        seq: Frames sent in this epoch before this one: consecutive, so gaps are losses.
        base_seq: Lossless service: the first frame the receiver has not confirmed yet. 0 in live service.
        frame_id: Index in the recording, or count of frames grabbed; increasing, but not consecutive.
        t_capture_ns: When the frame was grabbed.
        t_source_ns: Recorded time.
        codec: Codec name.
        digest: Its digest.
        image_hw: Height and width in pixels; it fixes the slot grid.
        modulation: How symbols travel.
        levels: Ends of the range of grey levels that was stretched to 0 .. 255 before encoding; with a knee
            also the level it is at, and the one it became, see ``Levels``.
        allocation: How many values each block sends, the code of ``Allocation``; empty at a fixed rate.
        num_slots: Of the grid.
        uses_per_slot: Of the grid, pilots included.
        direction: ``tx`` carries data symbols only, ``rx`` pilots and data as received.
        payload_format: ``qam16``: 4-bit indices of the data symbols, two to a byte; ``qam16_shaped``: the
            same, of points ``phy.qam.SHAPED_SPACING`` times further apart; ``iq16``: float16 I and Q;
            ``lost``: nothing arrived (lossless service only, so that the receiver can go on).
        payload: See ``symbol_payload``.
        slot_lost: One bit per slot, first slot highest, 1 where nothing arrived; empty on ``tx``.
        lossless: See ``CameraInfo``.
        final: Last frame of a finite source.
    """

    kind: str = _kind("symbols")
    agent_epoch: int = field(metadata=_COUNT)
    seq: int = field(metadata=_SEQ)
    base_seq: int = field(default=0, metadata=_COUNT)
    frame_id: int = field(metadata=_COUNT)
    t_capture_ns: int = field(metadata=_TIME_NS)
    t_source_ns: int = field(metadata=_TIME_NS)
    codec: str = field(metadata=_NAME)
    digest: str = field(metadata=_DIGEST)
    image_hw: tuple[int, int] = field(metadata=_SIZE)
    modulation: Modulation = field(metadata=rule(Choice(MODULATIONS)))
    levels: tuple[int, ...] = field(default=(0, 255), metadata=rule(Many(WholeNumber(0, 255), at_most=4)))
    allocation: bytes = field(default=b"", metadata=rule(Bytes(_MAX_ALLOCATION_BYTES)))
    num_slots: int = field(metadata=rule(WholeNumber(1, MAX_SIDE_PX)))
    uses_per_slot: int = field(metadata=rule(WholeNumber(1, USES_PER_BLOCK * MAX_SIDE_PX)))
    direction: Literal["tx", "rx"] = field(metadata=rule(Choice(("tx", "rx"))))
    payload_format: PayloadFormat = field(metadata=rule(Choice(PAYLOAD_FORMATS)))
    payload: bytes = field(metadata=rule(Bytes(MAX_PAYLOAD_BYTES)))
    slot_lost: bytes = field(default=b"", metadata=rule(Bytes(MAX_SIDE_PX // 8)))
    lossless: bool = field(default=False, metadata=rule(Flag()))
    final: bool = field(default=False, metadata=rule(Flag()))

    @property
    def layout(self) -> SlotLayout:
        """The slot grid."""
        return layout_for(self.image_hw)

    def consistent(self) -> None:
        """Check that numbers and levels rise, and that grid, payload and losses belong together.

        Received samples must be few enough to be sent.

        Raises:
            FieldError: They don't.
        """
        if self.base_seq > self.seq:
            raise FieldError("range", f"base_seq must be at most seq {self.seq}, got {self.base_seq}")
        if len(self.levels) not in (2, 4):
            raise FieldError("shape", f"levels must have 2 or 4 elements, got {len(self.levels)}")
        low, high, *knee = self.levels
        rising = (low, knee[0], high) if knee else (low, high)
        if list(rising) != sorted(set(rising)) or (knee and not 0 < knee[1] < 255):
            raise FieldError("range", f"levels must rise, got {list(self.levels)}")
        layout = self.layout
        if (self.num_slots, self.uses_per_slot) != (layout.num_slots, layout.uses_per_slot):
            raise FieldError(
                "shape",
                f"slots of a {self.image_hw} image must be {layout.num_slots}x{layout.uses_per_slot}, "
                f"got {self.num_slots}x{self.uses_per_slot}",
            )
        num_bytes = received_bytes(layout)
        if num_bytes > MAX_PAYLOAD_BYTES:
            # Small on its way to the channel, or lost, it would become large only where it is worked on.
            raise FieldError(
                "range",
                f"samples of a {self.image_hw} image must have at most {MAX_PAYLOAD_BYTES} bytes, "
                f"got {num_bytes}",
            )
        if self.direction == "tx":
            symbols = layout.num_slots * layout.data_per_slot
            packed = (symbols + 1) // 2
            sizes = {"qam16": packed, "qam16_shaped": packed, "iq16": IQ_BYTES * symbols}
        else:
            sizes = {"iq16": num_bytes, "lost": 0}
        if self.payload_format not in sizes:
            raise FieldError("range", f"payload_format {self.payload_format} is not for {self.direction}")
        if len(self.payload) != sizes[self.payload_format]:
            raise FieldError(
                "shape", f"payload must have {sizes[self.payload_format]} bytes, got {len(self.payload)}"
            )
        expected = (layout.num_slots + 7) // 8 if self.direction == "rx" else 0
        if len(self.slot_lost) != expected:
            raise FieldError("shape", f"slot_lost must have {expected} bytes, got {len(self.slot_lost)}")
        try:
            if self.allocation:
                Allocation.from_code(self.allocation, (layout.num_slots, layout.blocks_per_slot))
        except ValueError as err:
            raise FieldError("shape", str(err)) from None


@dataclass(frozen=True, kw_only=True)
class SourceImage(_Versioned):
    """Agent to recorders: a frame as it was before the encoder. It does not cross the channel.

    Attributes:
        agent_epoch: See ``CameraInfo``.
        frame_id: Of the ``SymbolFrame`` with the same content.
        image_hw: Height and width in pixels.
        image_format: ``jpeg`` or ``png``.
        data: The compressed image.
    """

    kind: str = _kind("source")
    agent_epoch: int = field(metadata=_COUNT)
    frame_id: int = field(metadata=_COUNT)
    image_hw: tuple[int, int] = field(metadata=_SIZE)
    image_format: Literal["jpeg", "png"] = field(metadata=rule(Choice(("jpeg", "png"))))
    data: bytes = field(metadata=rule(Bytes(MAX_PAYLOAD_BYTES)))


@dataclass(frozen=True, kw_only=True)
class LinkReport(_Versioned):
    """Receiver to agent: how good the link was for a frame that is decoded, and how many were passed over.

    Attributes:
        agent_epoch: Whose frame.
        frame_id: Of the frame.
        snr_db_estimate: What the transmitter should expect, see ``link_report``.
        t_capture_ns: The agent's own time of capture, for the age.
        num_superseded: Frames of this epoch that arrived and were passed over so far, since newer ones came.
    """

    kind: str = _kind("link")
    agent_epoch: int = field(metadata=_COUNT)
    frame_id: int = field(metadata=_COUNT)
    snr_db_estimate: float = field(metadata=_DB)
    t_capture_ns: int = field(metadata=_TIME_NS)
    num_superseded: int = field(metadata=_COUNT)


@dataclass(frozen=True, kw_only=True)
class FlowMessage(_Versioned):
    """Receiver to agent: how far it is, and how many frames may be under way.

    In live service it is sent only before the first frame and says that the server is ready for the epoch.

    Attributes:
        agent_epoch: Whose frames; 0 when the receiver has seen none yet.
        next_seq: First frame the consumer is not done with yet; earlier ones need not be kept.
        arrived_seq: First frame that has not arrived yet; earlier ones need not be sent again.
        window: Frames that may be sent from ``next_seq`` on.
    """

    kind: str = _kind("flow")
    agent_epoch: int = field(metadata=_COUNT)
    next_seq: int = field(metadata=_COUNT)
    arrived_seq: int = field(metadata=_COUNT)
    window: int = field(metadata=rule(WholeNumber(1, 1000)))


@dataclass(frozen=True, kw_only=True)
class ChannelReport(_Versioned):
    """Channel node to viewers: what was done to a frame. The receiver never decodes with it."""

    kind: str = _kind("channel")
    agent_epoch: int = field(metadata=_COUNT)
    frame_id: int = field(metadata=_COUNT)
    channel: str = field(metadata=_NAME)
    snr_db_set: float = field(metadata=_DB)
    num_slots: int = field(metadata=_COUNT)
    num_slots_lost: int = field(metadata=_COUNT)
    frame_lost: bool = field(metadata=rule(Flag()))


@dataclass(frozen=True, kw_only=True)
class PoseMessage(_Versioned):
    """The camera's pose for one frame.

    Attributes:
        T_world_cam: 4x4, row by row, or None while it is not known.
        state: Of the tracker. It goes on tracking after images that show nothing, which have no pose.
        covariance: 6x6, row by row, rotation before translation, or None: against the start of the map, with
            what adds up on the way and, in a part whose place is guessed, what the guess is worth.
        map_epoch: Counts map resets; poses of two epochs have unrelated world frames.
        submap: Part of the map the frame belongs to. A new part's place and scale in the world are guessed
            until it meets an older one and becomes part of it.
    """

    kind: str = _kind("pose")
    agent_epoch: int = field(metadata=_COUNT)
    frame_id: int = field(metadata=_COUNT)
    t_capture_ns: int = field(metadata=_TIME_NS)
    t_source_ns: int = field(metadata=_TIME_NS)
    T_world_cam: tuple[float, ...] | None = field(metadata=rule(Maybe(Many(Number(), count=16))))
    state: str = field(metadata=rule(Choice(TRACKING_STATES)))
    num_inliers: int = field(metadata=_COUNT)
    covariance: tuple[float, ...] | None = field(metadata=rule(Maybe(Many(Number(), count=36))))
    map_epoch: int = field(metadata=_COUNT)
    submap: int = field(default=0, metadata=_COUNT)


@dataclass(frozen=True, kw_only=True)
class MetricPose(_Versioned):
    """The camera's pose for one frame in metres and in the frame of a marker, behind its ``pose``.

    Attributes:
        T_marker_cam: 4x4, row by row, metres.
        covariance: As of the ``pose``, translation in metres; the unit's own uncertainty is not in it.
        m_per_unit: Metres in a unit of the part of the map that the frame is in.
        relative_sigma: Standard deviation of that as a share of it.
        T_marker_world: 4x4, row by row: ``p_marker = R (m_per_unit p_world) + t`` for points of that part.
        marker_id: Number of the marker.
        num_keyframes: That show it alike.
    """

    kind: str = _kind("metric_pose")
    agent_epoch: int = field(metadata=_COUNT)
    frame_id: int = field(metadata=_COUNT)
    t_capture_ns: int = field(metadata=_TIME_NS)
    t_source_ns: int = field(metadata=_TIME_NS)
    T_marker_cam: tuple[float, ...] = field(metadata=rule(Many(Number(), count=16)))
    covariance: tuple[float, ...] | None = field(metadata=rule(Maybe(Many(Number(), count=36))))
    m_per_unit: float = field(metadata=rule(Number(0.0)))
    relative_sigma: float = field(metadata=rule(Number(0.0)))
    T_marker_world: tuple[float, ...] = field(metadata=rule(Many(Number(), count=16)))
    marker_id: int = field(metadata=_COUNT)
    num_keyframes: int = field(metadata=_COUNT)
    map_epoch: int = field(metadata=_COUNT)
    submap: int = field(metadata=_COUNT)


@dataclass(frozen=True, kw_only=True)
class MapMessage(_Versioned):
    """What changed in the map.

    Attributes:
        ids: ``(N,)`` int64 landmarks that are new or moved.
        xyz: ``(N, 3)`` float32 in the world frame, map units.
        rgb: ``(N, 3)`` uint8.
        confidence: ``(N,)`` float32 in [0, 1].
        removed: ``(M,)`` int64 landmarks that are gone.
        keyframe_ids: ``(K,)`` int64 keyframes that are new or moved.
        keyframe_poses: ``(K, 4, 4)`` float64 ``T_world_cam``.
    """

    kind: str = _kind("map")
    agent_epoch: int = field(metadata=_COUNT)
    map_epoch: int = field(metadata=_COUNT)
    ids: NDArray[np.int64] = field(metadata=rule(Array("int64", (None,))))
    xyz: NDArray[np.float32] = field(metadata=rule(Array("float32", (None, 3))))
    rgb: NDArray[np.uint8] = field(metadata=rule(Array("uint8", (None, 3))))
    confidence: NDArray[np.float32] = field(metadata=rule(Array("float32", (None,))))
    removed: NDArray[np.int64] = field(metadata=rule(Array("int64", (None,))))
    keyframe_ids: NDArray[np.int64] = field(metadata=rule(Array("int64", (None,))))
    keyframe_poses: NDArray[np.float64] = field(
        metadata=rule(Array("float64", (None, 4, 4), max_items=16 * MAX_KEYFRAMES))
    )

    def consistent(self) -> None:
        """Check that the arrays have one row per landmark and keyframe.

        Raises:
            FieldError: They don't.
        """
        if not len(self.ids) == len(self.xyz) == len(self.rgb) == len(self.confidence):
            raise FieldError("shape", "ids, xyz, rgb and confidence must have one row per landmark")
        if len(self.keyframe_ids) != len(self.keyframe_poses):
            raise FieldError("shape", "keyframe_ids and keyframe_poses must have one row per keyframe")


@dataclass(frozen=True, kw_only=True)
class StatusMessage(_Versioned):
    """How a process is doing, once a second.

    Attributes:
        role: Of the process.
        agent_epoch: Of the stream it works on, 0 while there is none.
        uptime_s: Since it started.
        rates_hz: Events per second over the last seconds, by name.
        counts: Events since the start, by name.
        drops: Frames dropped since the start, by reason.
        stages_ms: Stage to (p50, p95, max) over the last frames.
        last_error: One line on what last went wrong, also where that is no more than a warning in the log;
            empty when nothing did. ``counts["errors"]`` is how often.
        activity: What it is at besides frames, in a few words; empty when it is at nothing else. Of an agent
            whose rate follows the link: how many channel uses a frame takes now.
        ended: Of an agent: its source came to its end, and ``counts["sent"]`` frames are all there are.
    """

    kind: str = _kind("status")
    role: str = field(metadata=rule(Choice(ROLES)))
    agent_epoch: int = field(metadata=_COUNT)
    uptime_s: float = field(metadata=rule(Number(0.0)))
    rates_hz: dict[str, float] = field(metadata=rule(Named(Number(0.0))))
    counts: dict[str, int] = field(metadata=rule(Named(WholeNumber())))
    drops: dict[str, int] = field(metadata=rule(Named(WholeNumber())))
    stages_ms: dict[str, tuple[float, ...]] = field(metadata=rule(Named(Many(Number(0.0), count=3))))
    last_error: str = field(metadata=rule(Text(1000)))
    activity: str = field(default="", metadata=rule(Text(200)))
    ended: bool = field(default=False, metadata=rule(Flag()))


@dataclass(frozen=True, kw_only=True)
class ControlRequest(_Versioned):
    """Asks a process to do something: ``get``, ``set``, ``reset``, ``save``, ..."""

    kind: str = _kind("request")
    op: str = field(metadata=_NAME)
    settings: dict[str, Any] = field(default_factory=dict, metadata=rule(Named(Setting())))


@dataclass(frozen=True, kw_only=True)
class ControlReply(_Versioned):
    """Answer to a ``ControlRequest``: the settings now in force, or one line of why it is not done."""

    kind: str = _kind("reply")
    ok: bool = field(metadata=rule(Flag()))
    error: str = field(default="", metadata=rule(Text(1000)))
    settings: dict[str, Any] = field(default_factory=dict, metadata=rule(Named(Setting())))


Message = (
    CameraInfo
    | SymbolFrame
    | SourceImage
    | LinkReport
    | FlowMessage
    | ChannelReport
    | PoseMessage
    | MetricPose
    | MapMessage
    | StatusMessage
    | ControlRequest
    | ControlReply
)
