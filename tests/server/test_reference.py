"""Image quality against the recorded originals."""

import shutil
import threading
from pathlib import Path

import numpy as np
from announced import announced_camera

from semcast.agent.originals import source_image
from semcast.agent.source import SourceFrame
from semcast.common.keys import source_key
from semcast.common.messages import SourceImage
from semcast.common.recorded_streams import RecordedStream
from semcast.common.recorder import Recorder
from semcast.common.recording_reader import RecordingReader
from semcast.common.recording_writer import recording_metadata
from semcast.common.sequence import open_sequence
from semcast.common.wire import pack
from semcast.server.reference import Reference, recording_reference, sequence_reference

CAMERA = announced_camera(agent_epoch=5)
STREAM = RecordedStream("a", CAMERA, num_received=7, num_transmitted=7)
DEMO = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"


def test_frames_are_compared_with_the_original_of_their_number_at_their_size():
    sequence = open_sequence(DEMO)
    small = sequence.intrinsics.scaled_to(613, 185)
    reference = sequence_reference(DEMO, small)
    same = reference.psnr_db(3, sequence.image(3, small)).result(20)
    other = reference.psnr_db(3, sequence.image(30, small)).result(20)
    assert same == 100.0
    assert other < 20
    assert len(reference.truth) == 51
    reference.close()
    reference.close()


def test_the_true_path_is_that_of_the_frames_whatever_times_the_agent_gives_them(tmp_path):
    untimed = tmp_path / "untimed"
    shutil.copytree(DEMO, untimed, ignore=shutil.ignore_patterns("times.txt"))
    sequence = open_sequence(untimed)
    reference = sequence_reference(untimed, sequence.intrinsics)
    t_source_ns = {k: round(k * 1e9 / 30.0) for k in range(5, 40)}
    there = reference.truth_of(t_source_ns)
    np.testing.assert_array_equal(there.t_s, np.array(list(t_source_ns.values())) * 1e-9)
    np.testing.assert_array_equal(there.positions, sequence.groundtruth().positions[5:40])
    assert reference.truth_of({}) is reference.truth
    reference.close()


def test_a_frame_without_original_has_no_psnr_and_is_reported_once(caplog):
    reference = sequence_reference(DEMO, open_sequence(DEMO).intrinsics)
    image = np.zeros((370, 1226, 3), np.uint8)
    with caplog.at_level("WARNING"):
        assert [reference.psnr_db(k, image).result(20) for k in (51, 52)] == [None, None]
    assert caplog.text.count("the reference has 51 frames: those of a second pass") == 1
    reference.close()


def test_only_one_comparison_is_under_way():
    image, asked, readable = np.zeros((8, 8, 3), np.uint8), [], threading.Event()

    def original(frame_id):
        asked.append(frame_id)
        readable.wait(20)
        return image

    reference = Reference(original)
    first = reference.psnr_db(0, image)
    assert [reference.psnr_db(k, image) for k in range(1, 20)] == [None] * 19
    readable.set()
    assert first.result(20) == 100.0
    assert reference.psnr_db(20, image).result(20) == 100.0
    assert asked == [0, 20]
    reference.close()


def write_originals(path, images, others=()):
    """A recording whose agent shared these frames: id to bytes of the message, or an image.

    ``others`` are those of another agent, whose start has the same time.
    """
    with Recorder(path, recording_metadata("", "0")) as recorder:
        for agent_id, (frame_id, image) in (*(("b", k) for k in others), *(("a", k) for k in images)):
            data = image
            if not isinstance(image, bytes):
                frame = SourceFrame(frame_id=frame_id, t_source_ns=0, t_capture_ns=0, stored=image)
                data = pack(source_image(frame, CAMERA.agent_epoch, "png"))
            recorder.put(source_key(agent_id), "source", data)
    return RecordingReader(path)


def test_originals_in_a_recording_are_found_by_frame_and_bad_ones_are_left_out(tmp_path):
    rng = np.random.default_rng(0)
    one, three = rng.integers(0, 256, (2, 48, 64, 3), dtype=np.uint8)
    other_size = np.zeros((24, 32, 3), np.uint8)
    empty = SourceImage(agent_epoch=5, frame_id=4, image_hw=(48, 64), image_format="png", data=b"")
    no_image = SourceImage(agent_epoch=5, frame_id=5, image_hw=(48, 64), image_format="png", data=b"x" * 99)
    messages = [(0, b"junk"), (1, one), (2, other_size), (3, three), (4, pack(empty)), (5, pack(no_image))]
    reference = recording_reference(write_originals(tmp_path / "r.mcap", messages), STREAM)
    found = [reference.psnr_db(k, one).result(20) for k in range(7)]
    assert found[1] == 100.0
    assert 5.0 < found[3] < 12.0
    assert [found[k] for k in (0, 2, 4, 5, 6)] == [None] * 5
    reference.close()


def test_an_original_of_another_agent_is_not_compared_with(tmp_path):
    ours, theirs = np.full((48, 64, 3), 200, np.uint8), np.zeros((48, 64, 3), np.uint8)
    file = write_originals(tmp_path / "r.mcap", [(1, ours)], others=[(1, theirs)])
    reference = recording_reference(file, STREAM)
    assert reference.psnr_db(1, ours).result(20) == 100.0
    reference.close()


def test_a_recording_without_originals_has_no_reference(tmp_path):
    assert recording_reference(write_originals(tmp_path / "r.mcap", [(0, b"junk")]), STREAM) is None
