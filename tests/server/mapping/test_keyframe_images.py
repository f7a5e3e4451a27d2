"""Images of keyframes are kept up to a number; finding landmarks in them is tested with the tracks."""

import numpy as np
import pytest

from semcast.server.mapping.keyframe_images import KeyframeImages, SeenFrom

GREY = np.zeros((4, 6), np.uint8)


def test_of_too_many_images_an_older_one_close_to_others_goes():
    images = KeyframeImages(6)
    for frame_id in (0, 10, 12, 14, 30, 40, 50, 60):
        images.append(SeenFrom(frame_id, GREY))
    assert [image.frame_id for image in images] == [0, 14, 30, 40, 50, 60]


def test_another_version_takes_the_place_of_that_keyframe_s_image_alone():
    images = KeyframeImages(6)
    for frame_id in (0, 10, 20):
        images.append(SeenFrom(frame_id, GREY))
    images.replace(SeenFrom(10, GREY + 1))
    images.replace(SeenFrom(15, GREY + 2))
    assert [(image.frame_id, int(image.grey[0, 0])) for image in images] == [(0, 0), (10, 1), (20, 0)]


def test_room_for_fewer_than_three_images_is_refused():
    with pytest.raises(ValueError, match="capacity must be at least 3, got 2"):
        KeyframeImages(2)
