"""Fixtures of the server's tests: a small exact run, a recording, and receivers on a hub."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.common.run_folder import RunData, write_run
from semcast.server.export.outputs import PLY_VERTEX
from semcast.server.image_writer import ImageWriter


def make_arc_run(num_frames=9, num_points=60, noise_px=0.0, seed=0):
    """Every second frame is a keyframe; frame ids start at 3 and skip one."""
    rng = np.random.default_rng(seed)
    camera = Intrinsics(fx=120, fy=110, cx=79.0, cy=61.5, width=160, height=120)
    xyz = rng.uniform((-3, -2, 5), (3, 2, 9), (num_points, 3))
    frame_ids = 3 + np.delete(np.arange(num_frames + 1), 4)
    poses = []
    for k in range(num_frames):
        a = 0.04 * (k - num_frames / 2)
        poses.append(make_transform(exp_so3((0.3 * a, -a, 0.2 * a)), (6 * a, 0.5 * a, 0.1 * k)))
    T_world_cam = np.array(poses)
    keyframes = frame_ids[::2]
    seen_by, seen, seen_xy = [], [], []
    for frame_id, T in zip(frame_ids, T_world_cam, strict=True):
        if frame_id not in keyframes:
            continue
        T_cam_world = invert_transform(T)
        xy = camera.project(xyz @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        inside = np.all((xy > 0) & (xy < (camera.width - 1, camera.height - 1)), axis=1)
        seen.append(np.flatnonzero(inside) + 100)
        seen_by.append(np.full(inside.sum(), frame_id))
        seen_xy.append(xy[inside] + noise_px * rng.standard_normal((inside.sum(), 2)))
    return RunData(
        intrinsics=camera,
        frame_ids=frame_ids,
        t_source_ns=frame_ids * 100_000_000,
        T_world_cam=T_world_cam,
        frame_submap=np.zeros(num_frames),
        keyframe_ids=keyframes,
        landmark_ids=np.arange(num_points) + 100,
        xyz=xyz,
        rgb=rng.integers(0, 256, (num_points, 3)),
        confidence=rng.uniform(0, 1, num_points),
        landmark_submap=np.zeros(num_points),
        observed_landmark_ids=np.concatenate(seen),
        observed_keyframe_ids=np.concatenate(seen_by),
        observed_xy=np.concatenate(seen_xy),
    )


def write_arc_run_to(folder, data, keep="keyframes"):
    write_run(folder, data)
    shape = (*data.intrinsics.shape_hw, 3)
    with ImageWriter(folder, lossless=True) as writer:
        for frame_id in (data.keyframe_ids if keep == "keyframes" else data.frame_ids).tolist():
            writer.put(frame_id, np.full(shape, 10 * frame_id, dtype=np.uint8))


def read_ply_from(path):
    """Return what ``write_ply`` wrote, as an array of ``PLY_VERTEX``."""
    header, end, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert end
    assert [line.split()[-1] for line in lines if line.startswith("property ")] == list(PLY_VERTEX.names)
    vertices = np.frombuffer(body, dtype=PLY_VERTEX)
    assert f"element vertex {len(vertices)}" in lines
    return vertices


@pytest.fixture
def arc_run():
    """Makes a run; see ``make_arc_run``."""
    return make_arc_run


@pytest.fixture
def write_arc_run():
    """Writes a run and images of one grey level a frame; see ``write_arc_run_to``."""
    return write_arc_run_to


@pytest.fixture
def read_ply():
    """Reads a map; see ``read_ply_from``."""
    return read_ply_from


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """The demo's first frames as they were sent and arrived."""
    from recorded_demo import record_demo

    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    record_demo(path)
    return path


@pytest.fixture(scope="session")
def whole(recording):
    """Summary of a replay of all of the recording, and its frames in the order they were processed."""
    from recorded_demo import without_depth

    from semcast.server.replay import replay

    seen = []
    summary = replay(without_depth(recording), None, seen.append)
    return summary, tuple(seen)


@pytest.fixture(scope="session")
def sent():
    """Symbols of a frame, and how they are received."""
    from receiver_ends import sent_and_received

    return sent_and_received()


@pytest.fixture
def make_frame(sent):
    """Makes frames as they are received; see ``frame_maker``."""
    from receiver_ends import frame_maker

    return frame_maker(sent[1])


@pytest.fixture
def ends():
    """Opens receivers, each with a client of its own; see ``Ends``."""
    from receiver_ends import Ends

    opened = []

    def open_ends(mode="live", **changes):
        opened.append(Ends(mode, **changes))
        return opened[-1]

    yield open_ends
    for one in opened:
        one.close()
