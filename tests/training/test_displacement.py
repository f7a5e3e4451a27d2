import math

import pytest
import torch

from semcast.training.displacement import (
    MAX_DISPLACEMENT_PX,
    gradients,
    grey,
    lucas_kanade_step,
    window_mean,
)


def blobs(shift_x=0.0, shift_y=0.0):
    row, column = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")
    image = torch.sin((column - shift_x) / 3.0) * torch.cos((row - shift_y) / 4.0)
    return (0.5 + 0.3 * image)[None, None]


@pytest.mark.parametrize("shift", [(0.3, 0.0), (0.0, -0.4), (0.25, 0.25)])
def test_a_small_shift_is_measured(shift):
    moved, strength = lucas_kanade_step(blobs(), blobs(*shift))
    inner = (slice(None), slice(None), slice(8, -8), slice(8, -8))
    corners = strength[inner] > strength[inner].median()
    assert moved[inner][corners].median().item() == pytest.approx(math.hypot(*shift), rel=0.1)


def test_points_and_gradients_are_those_of_the_template():
    faint, clear = 0.5 + 0.1 * (blobs() - 0.5), blobs(0.3)
    moved, strength = lucas_kanade_step(faint, clear)
    other, stronger = lucas_kanade_step(clear, faint)
    assert (stronger.mean() / strength.mean()).item() == pytest.approx(100.0, rel=0.1)
    assert moved.mean() > 3.0 * other.mean(), "what is nine tenths missing in the template moves it far"


def test_an_unchanged_image_does_not_move():
    moved, _ = lucas_kanade_step(blobs(), blobs())
    assert moved.abs().max().item() == 0.0


def test_steps_are_clipped_and_flat_images_are_no_corners():
    generator = torch.Generator().manual_seed(0)
    moved, strength = lucas_kanade_step(blobs() * 0.01, torch.rand(1, 1, 48, 48, generator=generator))
    assert moved.max().item() <= MAX_DISPLACEMENT_PX
    _, flat = lucas_kanade_step(torch.full((1, 1, 16, 16), 0.5), torch.zeros(1, 1, 16, 16))
    assert flat.abs().max().item() < 1e-9
    assert (strength >= 0).all()


def test_gradients_of_a_ramp_are_its_slope():
    ramp = (0.01 * torch.arange(16.0)).expand(1, 1, 16, 16)
    ix, iy = gradients(ramp)
    torch.testing.assert_close(ix[..., 2:-2, 2:-2], torch.full((1, 1, 12, 12), 0.01))
    assert iy.abs().max().item() < 1e-7


def test_the_mean_over_a_window_is_that_of_what_lies_inside():
    values = torch.rand(2, 3, 30, 26, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    at_once = torch.nn.functional.avg_pool2d(values, 21, stride=1, padding=10, count_include_pad=False)
    torch.testing.assert_close(window_mean(values, 21), at_once)


def test_luma_of_grey_is_grey():
    x = torch.full((1, 3, 2, 2), 0.4)
    torch.testing.assert_close(grey(x), torch.full((1, 1, 2, 2), 0.4))
