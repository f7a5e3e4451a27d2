import dataclasses
import math
import time
import tracemalloc

import msgpack
import numpy as np
import pytest
from announced import announced_camera
from hypothesis import given, settings
from hypothesis import strategies as st

from semcast.common.errors import ProtocolError
from semcast.common.messages import (
    MAX_KEYFRAMES,
    CameraInfo,
    ChannelReport,
    ControlReply,
    ControlRequest,
    FlowMessage,
    LinkReport,
    MapMessage,
    MetricPose,
    PoseMessage,
    StatusMessage,
    SymbolFrame,
)
from semcast.common.phy.slots import layout_for
from semcast.common.wire import MAX_MESSAGE_BYTES, WireError, pack, unpack

HW = (20, 33)
LAYOUT = layout_for(HW)


def examples():
    n = 3
    return [
        announced_camera(
            agent_id="cam-1", agent_epoch=5, cy=-3.5, image_wh=(640, 480), digest="00ff", source_name="über",
            lossless=True,
        ),
        SymbolFrame(
            agent_epoch=2**62, seq=7, base_seq=3, frame_id=9, t_capture_ns=-5, t_source_ns=10**18, codec="x",
            digest="ab", image_hw=HW, modulation="analog", num_slots=LAYOUT.num_slots,
            uses_per_slot=LAYOUT.uses_per_slot, direction="rx", payload_format="iq16",
            payload=bytes(4 * LAYOUT.num_uses), slot_lost=b"\x80", lossless=True, final=True,
        ),
        LinkReport(
            agent_epoch=1, frame_id=0, snr_db_estimate=-3.25, t_capture_ns=1, num_superseded=2
        ),
        FlowMessage(agent_epoch=0, next_seq=4, arrived_seq=6, window=4),
        ChannelReport(
            agent_epoch=1, frame_id=2, channel="awgn", snr_db_set=2.0, num_slots=24, num_slots_lost=1,
            frame_lost=False,
        ),
        PoseMessage(
            agent_epoch=1, frame_id=2, t_capture_ns=3, t_source_ns=4,
            T_world_cam=tuple(np.eye(4).ravel().tolist()), state="tracking",
            num_inliers=80, covariance=None, map_epoch=0,
        ),
        MetricPose(
            agent_epoch=1, frame_id=2, t_capture_ns=3, t_source_ns=4,
            T_marker_cam=tuple(np.eye(4).ravel().tolist()), covariance=tuple(np.eye(6).ravel().tolist()),
            m_per_unit=0.4, relative_sigma=0.01, T_marker_world=tuple(np.eye(4).ravel().tolist()),
            marker_id=7, num_keyframes=3, map_epoch=0, submap=1,
        ),
        MapMessage(
            agent_epoch=1, map_epoch=2, ids=np.arange(n), xyz=np.ones((n, 3), np.float32),
            rgb=np.zeros((n, 3), np.uint8), confidence=np.full(n, 0.5, np.float32),
            removed=np.zeros(0, np.int64), keyframe_ids=np.array([4]), keyframe_poses=np.eye(4)[None],
        ),
        StatusMessage(
            role="agent", agent_epoch=1, uptime_s=2.5, rates_hz={"sent": 9.9}, counts={"sent": 12},
            drops={"stale": 1}, stages_ms={"encode": (1.0, 2.0, 3.0)}, last_error="",
        ),
        ControlRequest(op="set", settings={"snr_db": 4.0, "channel": "awgn", "trace_file": None, "x": True}),
        ControlReply(ok=False, error="snr_db must be in [-5, 30], got 42"),
    ]  # fmt: skip


def values_of(message):
    return msgpack.unpackb(pack(message))


def refused(data, cls):
    with pytest.raises(ProtocolError) as caught:
        unpack(data, cls)
    return caught.value


@pytest.mark.parametrize("message", examples(), ids=lambda m: m.kind)
def test_messages_come_back_as_they_were(message):
    data = pack(message)
    back = unpack(data, type(message))
    for name, value in vars(message).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(back, name), value)
            assert getattr(back, name).dtype == value.dtype
        else:
            assert getattr(back, name) == value
            assert type(getattr(back, name)) is type(value)
    assert list(values_of(message))[:2] == ["version", "kind"]


@pytest.mark.parametrize("message", examples(), ids=lambda m: m.kind)
def test_a_message_cut_anywhere_is_refused(message):
    data = pack(message)
    for length in {0, 1, 2, len(data) // 3, len(data) // 2, len(data) - 1}:
        assert refused(data[:length], type(message)).reason == "syntax"
    assert refused(data + b"\x00", type(message)).reason == "syntax"


@pytest.mark.parametrize("message", examples(), ids=lambda m: m.kind)
def test_each_field_missing_or_of_another_type_is_refused(message):
    good = values_of(message)
    optional = {"base_seq", "slot_lost", "lossless", "final", "error", "settings", "submap", "last_frame_id"}
    optional |= {"readout_ms", "readout_from", "levels", "allocation", "activity", "ended"}
    for name in good:
        if name not in optional and name not in ("version", "kind"):
            without = {k: v for k, v in good.items() if k != name}
            assert refused(msgpack.packb(without), type(message)).reason == "missing"
        wrong = {**good, name: {"a": b"b"} if not isinstance(good[name], dict) else 7}
        assert refused(msgpack.packb(wrong), type(message)).reason in ("type", "version", "kind")


@pytest.mark.parametrize(
    ("cls", "change", "reason"),
    [
        (SymbolFrame, {"version": 2}, "version"),
        (SymbolFrame, {"version": True}, "version"),
        (SymbolFrame, {"kind": "pose"}, "kind"),
        (SymbolFrame, {"surprise": 1}, "unknown"),
        (SymbolFrame, {"seq": -1}, "range"),
        (SymbolFrame, {"seq": 2**64 - 1}, "range"),
        (SymbolFrame, {"seq": 2**63 - 1}, "range"),  # none could follow it
        (SymbolFrame, {"seq": True}, "type"),
        (SymbolFrame, {"seq": 1.0}, "type"),
        (SymbolFrame, {"image_hw": [0, 5]}, "range"),
        (SymbolFrame, {"image_hw": [8192, 8192]}, "shape"),
        (SymbolFrame, {"image_hw": [20]}, "shape"),
        (SymbolFrame, {"num_slots": 3}, "shape"),
        (SymbolFrame, {"payload": b"short"}, "shape"),
        (SymbolFrame, {"payload_format": "qam16"}, "range"),
        (SymbolFrame, {"payload_format": "pickle"}, "range"),
        (SymbolFrame, {"slot_lost": b""}, "shape"),
        (SymbolFrame, {"codec": "../../etc"}, "range"),
        (SymbolFrame, {"modulation": "qpsk"}, "range"),
        (SymbolFrame, {"levels": [40, 40]}, "range"),
        (SymbolFrame, {"allocation": b"\xff\xff\xff"}, "shape"),
        (SymbolFrame, {"allocation": "abc"}, "type"),
        (SymbolFrame, {"levels": [0, 256]}, "range"),
        (SymbolFrame, {"levels": [0, 255, 50]}, "shape"),
        (SymbolFrame, {"levels": [0, 255, 0, 180]}, "range"),
        (SymbolFrame, {"levels": [0, 200, 200, 180]}, "range"),
        (SymbolFrame, {"levels": [0, 255, 50, 255]}, "range"),
        (CameraInfo, {"fx": math.nan}, "range"),
        (CameraInfo, {"fx": 0.0}, "range"),
        (CameraInfo, {"cx": math.inf}, "range"),
        (CameraInfo, {"agent_id": "a/b"}, "range"),
        (CameraInfo, {"source_name": "x" * 201}, "range"),
        (LinkReport, {"snr_db_estimate": math.nan}, "range"),
        (PoseMessage, {"T_world_cam": [1.0] * 15}, "shape"),
        (PoseMessage, {"T_world_cam": [math.inf] * 16}, "range"),
        (StatusMessage, {"counts": {str(k): k for k in range(201)}}, "shape"),
        (StatusMessage, {"role": "spy"}, "range"),
        (MapMessage, {"ids": ["int64", [2**40], b""]}, "range"),
        (MapMessage, {"ids": ["int64", [4], bytes(32)]}, "shape"),
        (MapMessage, {"ids": ["int64", [3], bytes(23)]}, "shape"),
        (MapMessage, {"ids": ["object", [3], bytes(24)]}, "type"),
        (MapMessage, {"xyz": ["float32", [3, 4], bytes(48)]}, "shape"),
        (MapMessage, {"xyz": ["float32", [3, 3], np.full(9, np.nan, np.float32).tobytes()]}, "range"),
        (MapMessage, {"keyframe_ids": ["int64", [2], bytes(16)]}, "shape"),
        (ControlRequest, {"settings": {"a": [1]}}, "type"),
    ],
)
def test_wrong_values_are_refused_with_their_reason(cls, change, reason):
    message = next(m for m in examples() if type(m) is cls)
    error = refused(msgpack.packb({**values_of(message), **change}), cls)
    assert error.reason == reason, str(error)


def test_a_message_of_another_kind_does_not_pass():
    link = next(m for m in examples() if isinstance(m, LinkReport))
    assert refused(pack(link), SymbolFrame).reason == "kind"


def test_a_message_that_would_be_refused_for_its_size_is_not_packed():
    frame_ids = np.arange(MAX_KEYFRAMES)
    poses = np.zeros((MAX_KEYFRAMES, 4, 4))
    count = 300_000
    values = {
        "agent_epoch": 1, "map_epoch": 0, "ids": np.arange(count), "xyz": np.zeros((count, 3), np.float32),
        "rgb": np.zeros((count, 3), np.uint8), "confidence": np.zeros(count, np.float32),
        "removed": np.zeros(0, np.int64), "keyframe_ids": frame_ids, "keyframe_poses": poses,
    }  # fmt: skip
    with pytest.raises(WireError, match="at most") as refusal:
        pack(MapMessage(**values))
    assert refusal.value.reason == "size"
    few = {name: values[name][:20_000] for name in ("ids", "xyz", "rgb", "confidence")}
    assert len(pack(MapMessage(**{**values, **few}))) < MAX_MESSAGE_BYTES


def test_oversized_messages_are_refused_unread():
    assert refused(bytes(MAX_MESSAGE_BYTES + 1), SymbolFrame).reason == "size"


@pytest.mark.parametrize(
    "data",
    [
        b"\xdd\xff\xff\xff\xff",  # an array that says it has 4 billion items
        b"\xdf\xff\xff\xff\xff",  # a map of as many
        b"\xc6\xff\xff\xff\xff",  # 4 GB of bytes
        b"\x91" * 100_000,  # nesting
        b"\xc7\x05\x01hello",  # an extension type
        b"\xd6\xff\x00\x00\x00\x00",  # a timestamp
        b"\x81\xa7version\xc1",  # a byte that means nothing
        b"\x81\x01\x02",  # a key that is no text
        b"\x81\xc4\x01a\x02",
        b"\xc0",
        b"",
        bytes(1_000_000),
    ],
)
def test_hostile_bytes_are_refused_at_once(data):
    started_s = time.thread_time()
    assert refused(data, SymbolFrame).reason == "syntax"
    assert time.thread_time() - started_s < 1.0


def test_many_lists_cost_no_memory():
    data = b"\x81\xa1a\xdc\x0f\xff" + (b"\xdc\x04\x00" + b"\x90" * 1024) * 4095
    tracemalloc.start()
    try:
        assert refused(data, SymbolFrame).reason == "syntax"
        assert tracemalloc.get_traced_memory()[1] < 2 * len(data)
    finally:
        tracemalloc.stop()


def test_what_may_not_be_received_can_not_be_sent():
    flow = FlowMessage(agent_epoch=-1, next_seq=0, arrived_seq=0, window=1)
    with pytest.raises(WireError, match=r"flow.agent_epoch must be in \[0, \d+\], got -1"):
        pack(flow)
    pose = next(m for m in examples() if isinstance(m, PoseMessage))
    with pytest.raises(WireError) as caught:
        pack(PoseMessage(**{**vars(pose), "T_world_cam": (float("nan"),) * 16}))
    assert caught.value.reason == "range"
    camera = next(m for m in examples() if isinstance(m, CameraInfo))
    with pytest.raises(WireError, match="source_name must be text that UTF-8 can hold"):
        pack(dataclasses.replace(camera, source_name="room\udcff"))
    for values in ({"trace_file": "/tmp/\udcff.csv"}, {"\udcff": 1}):
        with pytest.raises(WireError, match="settings must be text that UTF-8 can hold"):
            pack(ControlRequest(op="set", settings=values))


REASONS = ("good", "syntax", "version", "kind", "unknown", "missing", "type", "range", "shape")


def outcome(data, cls):
    """Return why a message was refused; one that is accepted must be fit to be passed on."""
    try:
        message = unpack(data, cls)
    except WireError as err:
        return err.reason
    pack(message)
    return "good"


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8)
    | st.binary(max_size=64),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=8,
)  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=300))
def test_random_bytes_raise_nothing_but_a_protocol_error(data):
    for message in examples():
        with pytest.raises(ProtocolError):
            unpack(data, type(message))


@settings(max_examples=200, deadline=None)
@given(pick=st.integers(0, len(examples()) - 1), data=st.data())
def test_messages_with_fields_replaced_are_valid_or_refused(pick, data):
    message = examples()[pick]
    values = values_of(message)
    for name in data.draw(st.lists(st.sampled_from(sorted(values)), min_size=1, max_size=3, unique=True)):
        values[name] = data.draw(PLAIN)
    assert outcome(msgpack.packb(values), type(message)) in REASONS


@settings(max_examples=300, deadline=None)
@given(pick=st.integers(0, len(examples()) - 1), data=st.data())
def test_messages_with_bytes_flipped_are_valid_or_refused(pick, data):
    message = examples()[pick]
    damaged = bytearray(pack(message))
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    assert outcome(bytes(damaged), type(message)) in REASONS
