"""What counts as an image of nothing."""

import cv2
import numpy as np
import pytest

from semcast.server.mapping.blank import shows_nothing


def test_even_images_show_nothing_whatever_the_noise():
    rng = np.random.default_rng(0)
    for level, noise_sd in ((0, 0.0), (5, 3.0), (128, 6.0), (255, 0.0)):
        noisy = level + rng.normal(0, noise_sd, (120, 160, 3))
        assert shows_nothing(noisy.clip(0, 255).astype(np.uint8))


@pytest.mark.parametrize("contrast", [1.0, 0.1])
def test_a_view_shows_something_in_the_dark_too(contrast):
    rng = np.random.default_rng(1)
    view = cv2.resize(rng.uniform(0, 255, (12, 16, 3)), (160, 120), interpolation=cv2.INTER_NEAREST)
    dark = contrast * view + rng.normal(0, 3, view.shape)
    assert not shows_nothing(dark.clip(0, 255).astype(np.uint8))


def test_images_smaller_than_a_cell_are_looked_at_as_they_are():
    assert shows_nothing(np.full((5, 5, 3), 7, np.uint8))
