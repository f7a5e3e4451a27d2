import numpy as np
import pytest

from semcast.server.mapping.state import DecodedFrame

IMAGE = np.zeros((4, 6, 3), np.uint8)
MAP = np.ones((4, 6), np.float32)


def test_a_frame_of_a_cameras_size_is_taken():
    DecodedFrame(0, 0, IMAGE).check((4, 6))
    DecodedFrame(0, 0, IMAGE[:, ::-1], MAP, MAP.astype(np.float64)).check((4, 6))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"image": IMAGE[:, :, 0]}, "image must have shape"),
        ({"image": IMAGE / 255.0}, "image must be uint8, got float64"),
        ({"image": IMAGE.astype(np.uint16)}, "image must be uint8, got uint16"),
        ({"confidence": MAP[1:]}, "confidence must have shape"),
        ({"confidence": MAP.astype(np.uint8)}, "confidence must be floating point in .0, 1., got uint8"),
        ({"keypoint_confidence": MAP > 0}, "keypoint_confidence must be floating point .*, got bool"),
        ({"slot_snr_db": np.zeros((2, 3), np.float32)}, r"slot_snr_db must have shape .*, got \(2, 3\)"),
    ],
)
def test_other_arrays_are_refused(arrays, message):
    with pytest.raises(ValueError, match=message):
        DecodedFrame(0, 0, **{"image": IMAGE, **arrays}).check((4, 6))
