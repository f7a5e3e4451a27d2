"""A replay over a channel of its own, and what tells it from one of symbols as received."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from announced import announced_camera

from semcast.agent.encoder import FrameEncoder
from semcast.agent.source import SourceFrame
from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.cli import main
from semcast.common.codecs import load_codec
from semcast.common.keys import camera_key, rx_key, tx_key
from semcast.common.phy.pilots import insert_pilots
from semcast.common.recording_writer import RecordingWriter, recording_metadata
from semcast.common.sequence import open_sequence
from semcast.common.symbol_payload import data_symbols, pack_iq, pack_lost
from semcast.common.wire import pack
from semcast.server.frame_rows import read_rows
from semcast.server.replay import ReplaySettings, replay

SEQUENCE = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"
FRAMES = 4


@pytest.fixture
def sent():
    """What an agent says of its camera, and the first frames it sends."""
    sequence, codec = open_sequence(SEQUENCE, resize=0.3), load_codec("jpeg-ldpc")
    camera = sequence.intrinsics
    encoder = FrameEncoder(codec, agent_epoch=1, lossless=False)
    frames = [
        encoder.encode(SourceFrame(k, int(sequence.times_ns[k]), k, sequence.image(k)), snr_db=15.0)
        for k in range(FRAMES)
    ]
    said = announced_camera(
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        image_wh=(camera.width, camera.height),
        codec=codec.name,
        digest=codec.digest,
        modulation=codec.modulation,
        num_frames=FRAMES,
        last_frame_id=FRAMES - 1,
    )
    return said, frames


def write_recording(file, camera, sent, received=()):
    """Record what an agent said and sent, and what came through a channel."""
    with file.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "test"))
        writer.add(camera_key("a"), "camera", 0, 0, pack(camera))
        for key, frames in ((tx_key("a"), sent), (rx_key("a"), received)):
            for k, frame in enumerate(frames):
                writer.add(key, "symbols", k, k, pack(frame))
        writer.finish()
    return file


def received_of(frame):
    """What a channel makes of a frame; it loses number 1."""
    link = Link(ChannelSettings(snr_db=20.0), 0)
    carried = link.transmit(insert_pilots(data_symbols(frame)), 0.0, frame.frame_id)
    slot_lost = pack_lost(carried.slot_lost)
    if frame.frame_id == 1:
        return replace(frame, direction="rx", payload_format="lost", payload=b"", slot_lost=slot_lost)
    payload = pack_iq(carried.slots_rx)
    return replace(frame, direction="rx", payload_format="iq16", payload=payload, slot_lost=slot_lost)


def frames_in(folder):
    return [row.frame_id for row in read_rows(folder / "frames.jsonl")]


def test_settings_of_a_replay_bring_it_about_again(sent, tmp_path):
    """The channel they name was in use only if the symbols were those that the agent sent."""
    camera, frames = sent
    file = write_recording(tmp_path / "run.mcap", camera, frames, [received_of(frame) for frame in frames])
    first, again, faded, both = (tmp_path / name for name in ("first", "again", "faded", "both"))
    words = ["replay", "--dense-cloud", "none"]
    main([*words, str(file), "--out", str(first)])
    main([*words, "--config", str(first / "settings.toml"), "--out", str(again)])
    assert frames_in(again) == frames_in(first) == [0, 2, 3]
    main([*words, "--config", str(first / "settings.toml"), "--out", str(faded), "--snr-db", "19"])
    main([*words, "--config", str(faded / "settings.toml"), "--out", str(both)])
    assert frames_in(both) == frames_in(faded) == [0, 1, 2, 3]


def test_symbols_that_no_channel_takes_cost_their_frame_alone(sent, tmp_path, caplog):
    camera, frames = sent
    layout = frames[1].layout
    nonsense = pack_iq(np.full((layout.num_slots, layout.data_per_slot), np.nan, np.complex64))
    wrong = replace(frames[1], payload_format="iq16", payload=nonsense)
    file = write_recording(tmp_path / "wrong.mcap", camera, (frames[0], wrong, *frames[2:]))
    seen = []
    replay(
        ReplaySettings(file=file, link=ChannelSettings(snr_db=15.0), dense_cloud="none"), None, seen.append
    )
    assert seen == [0, 2, 3]
    assert f"frame 1 of {file} is left out: symbols must be finite" in caplog.text
