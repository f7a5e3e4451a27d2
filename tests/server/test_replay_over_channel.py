"""A replay over a channel of its own: what a recorded agent sent wrong costs its frame alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from announced import announced_camera

from semcast.agent.encoder import FrameEncoder
from semcast.agent.source import SourceFrame
from semcast.channel.settings import ChannelSettings
from semcast.common.codecs import load_codec
from semcast.common.keys import camera_key, tx_key
from semcast.common.recording_writer import RecordingWriter, recording_metadata
from semcast.common.sequence import open_sequence
from semcast.common.symbol_payload import pack_iq
from semcast.common.wire import pack
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


def test_symbols_that_no_channel_takes_cost_their_frame_alone(sent, tmp_path, caplog):
    camera, frames = sent
    layout = frames[1].layout
    nonsense = pack_iq(np.full((layout.num_slots, layout.data_per_slot), np.nan, np.complex64))
    wrong = replace(frames[1], payload_format="iq16", payload=nonsense)
    file = tmp_path / "wrong.mcap"
    with file.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "test"))
        writer.add(camera_key("a"), "camera", 0, 0, pack(camera))
        for k, frame in enumerate((frames[0], wrong, *frames[2:])):
            writer.add(tx_key("a"), "symbols", k, k, pack(frame))
        writer.finish()
    seen = []
    replay(
        ReplaySettings(file=file, link=ChannelSettings(snr_db=15.0), dense_cloud="none"), None, seen.append
    )
    assert seen == [0, 2, 3]
    assert f"frame 1 of {file} is left out: symbols must be finite" in caplog.text
