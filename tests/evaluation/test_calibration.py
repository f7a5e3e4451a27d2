import numpy as np
import pytest

from semcast.evaluation.calibration import normalised_ause, reliability, sparsification_curve


def test_ece_by_hand():
    # bins of width 0.5: two samples at 0.2 that come true at 0.4, two at 0.8 that come true at 0.7
    table = reliability([0.2, 0.2, 0.8, 0.8], [0.3, 0.5, 0.7, 0.7], num_bins=2)
    assert table.predicted.tolist() == pytest.approx([0.2, 0.8])
    assert table.observed.tolist() == pytest.approx([0.4, 0.7])
    assert table.share.tolist() == [0.5, 0.5]
    assert table.ece == pytest.approx(0.5 * 0.2 + 0.5 * 0.1)


def test_a_true_probability_is_calibrated(rng):
    p = rng.random(200_000)
    assert reliability(p, rng.random(200_000) < p).ece < 0.01
    assert reliability(p, rng.random(200_000) < p**2).ece > 0.1


def test_reliability_takes_the_ends_of_the_range_and_refuses_more():
    assert reliability([0.0, 1.0], [0.0, 1.0]).ece == 0.0
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        reliability([1.2], [1.0])
    with pytest.raises(ValueError, match="at least one"):
        reliability([], [])


def test_sparsification_by_hand():
    # removing the most uncertain half leaves errors 1 and 2
    curve = sparsification_curve([1, 2, 3, 4], [1, 2, 6, 3], num_points=2)
    assert curve.tolist() == pytest.approx([3.0, 1.5])


def test_ause_of_oracle_constant_and_inverted_maps(rng):
    errors = rng.exponential(size=5000)
    assert normalised_ause(errors, errors) == pytest.approx(0.0)
    assert normalised_ause(errors**3, errors) == pytest.approx(0.0)
    assert normalised_ause(np.ones(5000), errors) == pytest.approx(1.0)
    assert normalised_ause(rng.random(5000), errors) == pytest.approx(1.0, abs=0.1)
    assert normalised_ause(-errors, errors) > 1.3


def test_ause_is_undefined_for_equal_errors():
    assert normalised_ause([1, 2, 3], [5, 5, 5]) is None
    with pytest.raises(ValueError, match="as many"):
        normalised_ause([1, 2], [1])
