import numpy as np
import pytest
import scipy  # its parts are loaded where they are used: statistics take seconds

from semcast.evaluation.statistics import (
    auroc,
    average_ranks,
    finite_mean,
    paired_bootstrap,
    percentiles,
    pose_auc_percent,
    small_sample_factor,
    spearman,
    student_quantile,
)


def test_ranks_share_ties():
    assert average_ranks([30, 10, 10, 20]).tolist() == [4, 1.5, 1.5, 3]


def test_ranks_agree_with_scipy(rng):
    x = rng.integers(0, 20, 200)
    np.testing.assert_allclose(average_ranks(x), scipy.stats.rankdata(x))


def test_auroc_by_hand():
    # positives 3 and 1 against negatives 2 and 1: wins 3>2, 3>1, loses 1<2, tie 1=1 -> 2.5 of 4
    assert auroc([3, 1, 2, 1], [True, True, False, False]) == pytest.approx(2.5 / 4)


def test_auroc_is_mann_whitney_and_flips_with_the_sign(rng):
    scores, positive = rng.normal(size=300).round(1), rng.random(300) < 0.3
    u = scipy.stats.mannwhitneyu(scores[positive], scores[~positive]).statistic
    value = auroc(scores, positive)
    assert value == pytest.approx(u / (positive.sum() * (~positive).sum()))
    assert auroc(-scores, positive) == pytest.approx(1 - value)


def test_auroc_without_a_class_is_undefined_and_nan_is_refused():
    assert auroc([1.0, 2.0], [True, True]) is None
    with pytest.raises(ValueError, match="NaN"):
        auroc([np.nan, 1.0], [True, False])


def test_spearman_by_hand_and_against_scipy(rng):
    assert spearman([1, 2, 3, 4], [1, 8, 27, 64]) == pytest.approx(1.0)
    # ranks 1 2 3 against 1 3 2: 1 - 6 * (0 + 1 + 1) / (3 * 8) = 0.5
    assert spearman([1, 2, 3], [10, 30, 20]) == pytest.approx(0.5)
    a, b = rng.integers(0, 9, 100), rng.integers(0, 9, 100)
    assert spearman(a, b) == pytest.approx(scipy.stats.spearmanr(a, b).statistic)


def test_spearman_of_a_constant_is_undefined():
    assert spearman([1, 1, 1], [1, 2, 3]) is None
    assert spearman([1], [2]) is None
    with pytest.raises(ValueError, match="one length"):
        spearman([1, 2], [1, 2, 3])


def test_pose_auc_by_hand():
    # two pairs, errors 0 and 5, threshold 10: recall rises 0 -> .5 at once, to 1 at 5, then stays.
    # trapezoids: 5 * (.5 + 1) / 2 + 5 * 1 = 8.75 of 10
    assert pose_auc_percent([5.0, 0.0], 10) == pytest.approx(87.5)
    # a failed pair never enters: (5 * .25 + 5 * .5) / 10
    assert pose_auc_percent([5.0, np.inf], 10) == pytest.approx(37.5)


def test_pose_auc_limits():
    assert pose_auc_percent(np.zeros(9), 5) == pytest.approx(100)
    assert pose_auc_percent(np.full(9, 90.0), 20) == pytest.approx(0)
    assert pose_auc_percent([], 5) is None
    with pytest.raises(ValueError, match="non-negative"):
        pose_auc_percent([-1.0], 5)
    with pytest.raises(ValueError, match="threshold_deg"):
        pose_auc_percent([1.0], 0)


def test_percentiles_by_hand():
    assert percentiles([1, 2, 3]) == {"p50": 2.0, "p95": pytest.approx(2.9)}
    assert percentiles([]) == {"p50": None, "p95": None}


def test_finite_mean_leaves_out_what_is_not_known():
    assert finite_mean([1.0, None, np.inf, 3.0]) == 2.0
    assert finite_mean([None, np.nan]) is None


def test_bootstrap_of_a_constant_difference_has_no_width(rng):
    b = rng.random(40) + 1
    result = paired_bootstrap(b + 0.25, b, rng)
    assert result.difference == pytest.approx(0.25)
    assert (result.low, result.high) == (pytest.approx(0.25), pytest.approx(0.25))


def test_bootstrap_agrees_with_the_normal_interval(rng):
    a, b = rng.normal(1.0, 2.0, 400), rng.normal(0.0, 2.0, 400)
    result = paired_bootstrap(a, b, rng)
    half = 1.96 * (a - b).std(ddof=1) / np.sqrt(400)
    assert result.low == pytest.approx((a - b).mean() - half, abs=0.1 * half)
    assert result.high == pytest.approx((a - b).mean() + half, abs=0.1 * half)
    assert result.low < 1.0 < result.high


def test_replicates_are_not_new_evidence(rng):
    d = rng.normal(size=30)
    one = paired_bootstrap(d, np.zeros(30), np.random.default_rng(0))
    copies = paired_bootstrap(np.tile(d[:, None], 50), np.zeros((30, 50)), np.random.default_rng(0))
    assert copies.high - copies.low == pytest.approx(one.high - one.low)
    assert copies.num_samples == 30


@pytest.mark.parametrize("gap", [1, 2])
def test_blocks_cover_what_they_say_where_pairs_share_frames(gap):
    rng = np.random.default_rng(4)
    num_trials, num_pairs = 400, 26
    hits = {1: 0, gap + 1: 0}
    for _ in range(num_trials):
        frames = rng.standard_normal(num_pairs + gap)
        d = frames[:num_pairs] + frames[gap:]  # two pairs ``gap`` rows apart share a frame
        for block in hits:
            found = paired_bootstrap(d, np.zeros(num_pairs), rng, block=block, num_resamples=300)
            hits[block] += found.low < 0 < found.high
    assert hits[1] < 0.87 * num_trials
    assert hits[gap + 1] > 0.87 * num_trials


def test_few_blocks_give_no_interval(rng):
    d = rng.standard_normal(20)
    assert paired_bootstrap(d, np.zeros(20), rng, block=4).low is not None
    few = paired_bootstrap(d, np.zeros(20), rng, block=5)
    assert few.low is None
    assert few.difference == pytest.approx(d.mean())


def test_blocks_widen_the_interval_of_correlated_rows(rng):
    d = np.repeat(rng.normal(size=40), 10)
    rows = paired_bootstrap(d, np.zeros(400), np.random.default_rng(0))
    blocks = paired_bootstrap(d, np.zeros(400), np.random.default_rng(0), block=10)
    assert blocks.high - blocks.low > 2 * (rows.high - rows.low)


def test_bootstrap_ratio_and_bad_input(rng):
    result = paired_bootstrap([1.0, 2.0, 3.0, 4.0, 5.0], [2.0, 4.0, 6.0, 8.0, 10.0], rng)
    assert result.ratio == pytest.approx(0.5)
    assert (result.ratio_low, result.ratio_high) == (pytest.approx(0.5), pytest.approx(0.5))
    assert paired_bootstrap([1.0, 1.0], [0.0, 0.0], rng).ratio is None
    assert paired_bootstrap([], [], rng) is None
    few = paired_bootstrap([1.0, 2.0, 3.0, 4.0], [2.0, 4.0, 6.0, 8.0], rng)
    assert (few.difference, few.ratio, few.num_samples) == (-2.5, 0.5, 4)
    assert (few.low, few.high, few.ratio_low, few.ratio_high) == (None,) * 4
    with pytest.raises(ValueError, match="share a shape"):
        paired_bootstrap([1.0], [1.0, 2.0], rng)
    with pytest.raises(ValueError, match="finite"):
        paired_bootstrap([np.inf], [1.0], rng)
    with pytest.raises(ValueError, match="level"):
        paired_bootstrap([1.0], [1.0], rng, level=1.0)


@pytest.mark.parametrize(("count", "student"), [(5, 2.776), (8, 2.365), (20, 2.093), (1000, 1.962)])
def test_few_samples_widen_an_interval_by_student_s_quantile(count, student):
    assert student_quantile(count) == pytest.approx(student, rel=0.003)
    expected = student / 1.95996 * np.sqrt(count / (count - 1))
    assert small_sample_factor(count) == pytest.approx(expected, rel=0.003)


def test_intervals_of_few_samples_cover_what_they_say(rng):
    covered = 0
    for _ in range(400):
        found = paired_bootstrap(rng.normal(0.3, 1.0, 8), np.zeros(8), rng, num_resamples=400)
        covered += found.low < 0.3 < found.high
    assert 0.925 < covered / 400 < 0.98
    with pytest.raises(ValueError, match="count must be at least 5, got 4"):
        small_sample_factor(4)
