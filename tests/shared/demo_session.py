"""Sessions of a server over frames of the demo, without a network."""

import time
from pathlib import Path

from semcast.common.sequence import open_sequence
from semcast.server.decoder import Arrival
from semcast.server.mapping.state import DecodedFrame
from semcast.server.session import Session
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity

DEMO = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"


def open_demo():
    """The demo, in small images."""
    return open_sequence(DEMO, resize=0.35)


def run_session(demo, folder, frame_ids, epoch=5, program=None, **settings):
    """A session over some frames of the demo; ends with its outputs unless it is ``killed``.

    Depth, which takes longer than all else, is left out unless ``settings`` want it.
    """
    killed = settings.pop("killed", False)
    picture = settings.pop("picture", lambda demo, k: demo.image(k))
    identity = StreamIdentity(
        agent_id="a", agent_epoch=epoch, codec="x", digest="", camera=demo.intrinsics, num_frames=None
    )
    session = Session(
        ServerSettings(bundle="inline", out=folder, **{"dense_cloud": "none", **settings}),
        identity,
        folder,
        None,
        program=program,
    )
    for k in frame_ids:
        now_ns = time.perf_counter_ns()
        frame = DecodedFrame(k, int(demo.times_ns[k]), picture(demo, k), None)
        session.process(frame, Arrival(None, None, now_ns, now_ns, {}, {}))
    try:
        if killed:
            session.save_checkpoint({})
        else:
            session.conclude()
            list(session.complete_cloud())
            session.write_outputs(folder, {}, complete=True)
    finally:
        session.close()
    return session
