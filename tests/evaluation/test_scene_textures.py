"""Textures stay what results were measured on, and are shrunk by halves."""

import cv2
import numpy as np
import pytest

from semcast.evaluation.scenes.textures import Texture, dead_leaves


def leaf_by_leaf(rng, contrast, max_radius_share):
    """Draw one leaf after the other, and grain over them."""
    mean = np.clip(rng.uniform(80, 170, (1, 1)) + rng.normal(0, 0.09 * 250, (1, 3)), 0, 255)[0]
    colours = np.clip(rng.uniform(0, 200, (12, 1)) + rng.normal(0, 0.09 * 200, (12, 3)), 0, 255)
    palette = np.clip(mean + contrast * (colours - 100), 0, 255)
    image = np.full((512, 512, 3), mean, np.uint8)
    shares = rng.uniform(0, 1, 1500)
    radii = ((1 - shares) * 2.0**-1.5 + shares * (512 * max_radius_share) ** -1.5) ** (-1 / 1.5)
    for radius in radii:
        colour = (palette[rng.integers(12)] + rng.normal(0, 9 * contrast)).tolist()
        centre = rng.uniform(0, 512, 2)
        if rng.uniform() < 0.5:
            axes = (2 * radius, 2 * radius * rng.uniform(0.4, 1))
            cv2.ellipse(image, (centre.tolist(), axes, rng.uniform(0, 180)), colour, -1)
        else:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 6)))
            corners = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
            cv2.fillPoly(image, [corners.astype(np.int32)], colour)
    grain = rng.normal(0, 4 * contrast, (512, 512))
    return np.clip(image + grain[..., None], 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("contrast", "max_radius_share"), [(1.0, 0.25), (0.35, 0.05)])
def test_dead_leaves_are_those_drawn_one_after_the_other(contrast, max_radius_share):
    rngs = np.random.default_rng(4), np.random.default_rng(4)
    expected = leaf_by_leaf(rngs[0], contrast, max_radius_share)
    found = dead_leaves(rngs[1], contrast, max_radius_share).image
    # A corner may be rounded to another pixel where a machine's sine differs in its last bit.
    assert (found != expected).mean() < 1e-4
    assert rngs[0].bit_generator.state == rngs[1].bit_generator.state, "what is drawn next stays too"


def test_levels_halve_the_image_and_keep_its_mean():
    image = np.random.default_rng(0).integers(0, 256, (64, 32, 3), dtype=np.uint8)
    levels = Texture(image).levels
    assert [level.shape for level in levels] == [(64, 32, 3), (32, 16, 3), (16, 8, 3), (8, 4, 3)]
    assert np.array_equal(levels[0], image)
    for level in levels:
        assert level.mean(axis=(0, 1)) == pytest.approx(image.mean(axis=(0, 1)), rel=1e-5)
