import math

import numpy as np
import pytest

from semcast.channel.erasure import gilbert_elliott, independent_losses


def run_lengths(flags):
    padded = np.concatenate([[False], flags, [False]])
    edges = np.flatnonzero(np.diff(padded.astype(np.int8)))
    return edges[1::2] - edges[::2]


def test_independent_losses_have_their_rate_and_no_memory(rng):
    lost = independent_losses(100_000, 0.2, rng)
    assert abs(lost.mean() - 0.2) < 4 * math.sqrt(0.16 / lost.size)
    after_loss = lost[1:][lost[:-1]]
    assert abs(after_loss.mean() - 0.2) < 4 * math.sqrt(0.16 / after_loss.size)


@pytest.mark.parametrize(("share", "mean_burst"), [(0.2, 4.0), (0.1, 10.0), (0.5, 1.0), (0.8, 4.0)])
def test_bursts_have_their_share_and_mean_length(share, mean_burst, rng):
    bad = gilbert_elliott(200_000, share, mean_burst, rng)
    lengths = run_lengths(bad)
    # Geometric lengths: standard deviation sqrt(m (m - 1)); the share varies with both kinds of runs.
    spread = math.sqrt(max(mean_burst * (mean_burst - 1), 1e-9) / lengths.size)
    assert abs(lengths.mean() - mean_burst) < max(4 * spread, 1e-9)
    assert abs(bad.mean() - share) < 4 * math.sqrt(2 * mean_burst * share * (1 - share) / bad.size)


def test_the_first_slot_is_as_likely_hit_as_any(rng):
    first = np.array([gilbert_elliott(3, 0.3, 5.0, rng) for _ in range(4000)])
    sigma = math.sqrt(0.21 / 4000)
    assert (np.abs(first.mean(axis=0) - 0.3) < 4 * sigma).all()


def test_no_bursts_and_no_slots(rng):
    assert not gilbert_elliott(50, 0.0, 3.0, rng).any()
    assert gilbert_elliott(0, 0.2, 3.0, rng).shape == (0,)


def test_bad_values_are_named(rng):
    with pytest.raises(ValueError, match=r"bad_share must be in \[0, 1\), got 1"):
        gilbert_elliott(5, 1.0, 3.0, rng)
    with pytest.raises(ValueError, match=r"mean_burst must be at least 1, got 0.5"):
        gilbert_elliott(5, 0.1, 0.5, rng)
    with pytest.raises(ValueError, match=r"mean_burst must be at least 4 for a share of 0.8, got 2"):
        gilbert_elliott(5, 0.8, 2.0, rng)
