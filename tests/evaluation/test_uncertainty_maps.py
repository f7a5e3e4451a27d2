import numpy as np
import pytest

from semcast.evaluation.uncertainty_maps import (
    absolute_error,
    block_means,
    gradient_energy,
    lambda_min,
    pixel_label,
    sample_at,
)


def square(size=64):
    image = np.zeros((size, size, 3), np.uint8)
    image[size // 4 : 3 * size // 4, size // 4 : 3 * size // 4] = 200
    return image


def test_label_by_hand():
    original = np.full((2, 2, 3), 100, np.uint8)
    decoded = original.copy()
    decoded[0, 0] = (100, 100, 130)
    error = absolute_error(decoded, original)
    assert error[0, 0] == pytest.approx(10 / 255)
    label = pixel_label(decoded, original, alpha=30)
    assert label[0, 0] == pytest.approx(1 - np.tanh(30 * 10 / 255), abs=1e-6)
    assert label[1, 1] == 1.0
    # the error is unsigned
    np.testing.assert_array_equal(absolute_error(original, decoded), error)


def test_edges_have_gradient_and_only_corners_have_two_directions():
    image = square()
    energy, smaller = gradient_energy(image), lambda_min(image)
    edge, corner, flat = (16, 32), (16, 16), (32, 32)
    assert energy[edge] > 100 * max(energy[flat], 1e-6)
    assert smaller[corner] > 100 * smaller[edge]
    assert smaller[flat] == pytest.approx(1e-9)


def test_block_means_by_hand_leave_the_border_out():
    values = np.arange(5 * 4, dtype=np.float32).reshape(5, 4)
    assert block_means(values, 2).tolist() == [2.5, 4.5, 10.5, 12.5]


def test_samples_are_bilinear_and_repeat_the_border():
    values = np.array([[0.0, 1.0], [2.0, 3.0]], np.float32)
    points = np.array([[0.5, 0.0], [0.0, 0.5], [1.0, 1.0], [5.0, -3.0]])
    np.testing.assert_allclose(sample_at(values, points), [0.5, 1.0, 3.0, 1.0], atol=0.02)
    assert sample_at(values, np.zeros((0, 2))).shape == (0,)
    assert sample_at(values, np.zeros((70_000, 2))).shape == (70_000,)
