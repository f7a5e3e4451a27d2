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


def sky(noise_sd):
    """Brighter towards the horizon and the sun."""
    y, x = np.mgrid[0.0:1.0:120j, 0.0:1.0:160j]
    shade = 150 + 70 * y - 30 * (x - 0.3) ** 2
    noise = np.random.default_rng(2).normal(0, noise_sd, (120, 160, 3))
    return (shade[..., None] + noise).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise_sd", [0.0, 4.0])
def test_bare_sky_shows_nothing(noise_sd):
    assert shows_nothing(sky(noise_sd))


def test_a_little_below_the_sky_is_something():
    image = sky(2.0)
    image[100:, 40:80] //= 2
    assert not shows_nothing(image)


@pytest.mark.parametrize("shape", [(8, 400, 3), (400, 20, 3), (47, 400, 3), (48, 48, 3)])
def test_images_of_few_cells_have_no_shade(shape):
    assert not shows_nothing(np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8))
