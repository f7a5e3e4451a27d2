"""Image quality against the recorded originals."""

from pathlib import Path

import numpy as np

from semcast.common.sequence import open_sequence
from semcast.server.reference import sequence_reference

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


def test_a_frame_without_original_has_no_psnr_and_is_reported_once(caplog):
    reference = sequence_reference(DEMO, open_sequence(DEMO).intrinsics)
    image = np.zeros((370, 1226, 3), np.uint8)
    with caplog.at_level("WARNING"):
        assert [reference.psnr_db(k, image).result(20) for k in (51, 52)] == [None, None]
    assert caplog.text.count("no PSNR") == 1
    reference.close()
