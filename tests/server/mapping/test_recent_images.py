"""The newest images, as tracks are followed from them."""

from copy import copy

import numpy as np
from shifted_texture import sight_at

from semcast.server.mapping.recent_images import RecentImages


def kept(num_images, num_older=3):
    images = RecentImages(num_older)
    for k in range(num_images):
        images.append(sight_at(10 + k, frame_id=k))
    return images


def test_the_newest_images_are_kept_newest_first():
    images = kept(6)
    assert (len(images), images.frame_ids) == (4, [5, 4, 3, 2])
    for back in range(4):
        np.testing.assert_array_equal(images[back], sight_at(15 - back).grey)


def test_a_copy_stays_as_it_is_whatever_becomes_of_the_other():
    images = kept(3)
    before, greys = copy(images), [images[back] for back in range(3)]
    images.bring_to_light((0.5, 3.0))
    images.bring_to_lamps(np.full(len(greys[0]), 1.5))
    images.replace_newest(sight_at(40))
    images.drop_newest()
    images.append(sight_at(30, frame_id=7))
    assert images.frame_ids == [7, 1, 0]
    assert before.frame_ids == [2, 1, 0]
    assert all(before[back] is grey for back, grey in enumerate(greys))


def test_points_are_found_by_descriptors_wherever_the_next_image_has_them():
    images, xy = kept(1), np.array([[150.0, 80.0], [120.0, 100.0], [200.0, 120.0]])
    carried = images.search_jump(sight_at(90), xy)
    np.testing.assert_allclose(carried.xy, xy - (80.0, 0.0), atol=1.5)
