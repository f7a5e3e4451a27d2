from dataclasses import replace

import numpy as np
import pytest

from semcast.server.geometry.weighting import (
    KeypointCues,
    NoiseModel,
    OnlineNoise,
    adaptive_threshold,
    fit_noise,
    fuse_confidence,
    geometric_confidence,
    localisation_variance_px2,
    observation_confidence,
    sampling_probability,
)


def cues(count=4, **changes):
    values = {
        "pixel_confidence": None,
        "keypoint_confidence": None,
        "gradient_grey2": np.full(count, 100.0),
        "forward_backward_px": np.zeros(count),
        "photometric_grey": np.zeros(count),
    }
    return KeypointCues(**{**values, **changes})


def test_a_match_is_trusted_as_its_weaker_end():
    fused = fuse_confidence(np.array([0.9, 0.2, 0.5]), np.array([0.4, 0.8, 0.5]))
    assert fused.tolist() == [0.4, 0.2, 0.5]


def test_sampling_probability_is_confidence_over_its_sum():
    assert np.allclose(sampling_probability(np.array([0.1, 0.3, 0.6])), [0.1, 0.3, 0.6])
    assert np.allclose(sampling_probability(np.array([0.2, 0.6])), [0.25, 0.75])
    assert np.allclose(sampling_probability(np.zeros(4)), 0.25)


def test_adaptive_threshold_grows_as_confidence_falls():
    delta = adaptive_threshold(np.array([1.0, 0.25, 0.0]), 2.0, epsilon=0.0025)
    assert np.allclose(delta, [2.0 / np.sqrt(1.0025), 2.0 / np.sqrt(0.2525), 2.0 / 0.05])


def test_the_sigma_of_a_confidence_by_hand():
    model = NoiseModel(sigma0_px=2.0, beta=3.0)
    # c = 1: sigma^2 = 4; c = 0: sigma^2 = 4 e^3
    assert np.allclose(model.sigma_px(np.array([1.0, 0.0])) ** 2, [4.0, 4.0 * np.e**3])
    assert np.allclose(model.sigma_px(np.array([1.0, 1 / 3])), [2.0, 2.0 * np.e])
    assert np.all(np.diff(model.sigma_px(np.linspace(0, 1, 11))) < 0)


def test_threshold_is_clamped_at_three_times_that_of_a_trusted_point():
    model = NoiseModel(sigma0_px=1.0, beta=8.0)
    trusted, distrusted = model.threshold_px(np.array([1.0, 0.0]))
    assert distrusted == pytest.approx(3.0 * trusted)


def test_threshold_does_not_close_with_sigma():
    narrow, narrower = (NoiseModel(s, 0.0).threshold_px(np.ones(1))[0] for s in (0.3, 0.25))
    assert narrow == narrower > 1.5


def test_fit_finds_sigma0_and_beta():
    rng = np.random.default_rng(0)
    c = rng.uniform(0.2, 1.0, 6000)
    truth = NoiseModel(0.8, 3.0)
    fitted = fit_noise(c, rng.standard_normal(6000) * truth.sigma_px(c))
    assert fitted is not None
    assert fitted.sigma0_px == pytest.approx(0.8, rel=0.1)
    assert fitted.beta == pytest.approx(3.0, abs=0.35)


@pytest.mark.parametrize("seed", range(5))
def test_confidence_without_information_falls_back_to_no_weights(seed):
    rng = np.random.default_rng(seed)
    fitted = fit_noise(rng.uniform(0, 1, 2000), rng.standard_normal(2000))
    assert fitted is not None
    assert fitted.beta < 0.35
    assert fitted.sigma0_px == pytest.approx(1.0, rel=0.15)


def test_misleading_confidence_falls_back_to_no_weights():
    rng = np.random.default_rng(1)
    c = rng.uniform(0, 1, 3000)
    fitted = fit_noise(c, rng.standard_normal(3000) * NoiseModel(1.0, 2.0).sigma_px(1.0 - c))
    assert fitted is not None
    assert fitted.beta == 0.0


def test_fit_withstands_outliers():
    rng = np.random.default_rng(2)
    c = rng.uniform(0.2, 1.0, 4000)
    residual = rng.standard_normal(4000) * NoiseModel(0.8, 3.0).sigma_px(c)
    residual[rng.random(4000) < 0.15] *= 20
    fitted = fit_noise(c, residual)
    assert fitted is not None
    assert fitted.sigma0_px == pytest.approx(0.8, rel=0.35)
    assert fitted.beta == pytest.approx(3.0, abs=0.7)


@pytest.mark.parametrize(("slope", "beta"), [(1.8, 0.0), (2.0, 2.0), (20.0, 8.0)])
def test_a_slope_counts_from_two_of_its_standard_errors_on(slope, beta):
    # Three groups of 12 at c = 1, 0.5, 0, each without spread: se = 2.33 / sqrt(12 * (0.25 + 0.25)) = 0.951.
    c = np.repeat([1.0, 0.5, 0.0], 12)
    fitted = fit_noise(c, 0.6 * np.exp(0.5 * slope * (1.0 - c)))
    assert fitted is not None
    assert fitted.beta == pytest.approx(beta)
    if beta == slope:
        assert fitted.sigma0_px == pytest.approx(0.6 / 0.67449)


@pytest.mark.parametrize(("middle", "beta"), [(2.5, 3.0), (3.0, 0.0)])
def test_groups_beside_the_line_make_its_slope_less_certain(middle, beta):
    # Log variances 0, middle, 3 at c = 1, 0.5, 0: with k = 2 middle - 3 the line of slope 3 misses them by
    # k/6, k/3, k/6. One degree of freedom is left, so the misfit is 12 / 2.33^2 * k^2 / 6 = 0.368 k^2. By its
    # root two standard errors of 0.951 grow: to 2.31 for k = 2 and to 3.46 for k = 3.
    c = np.repeat([1.0, 0.5, 0.0], 12)
    fitted = fit_noise(c, 0.6 * np.exp(0.5 * np.repeat([0.0, middle, 3.0], 12)))
    assert fitted is not None
    assert fitted.beta == pytest.approx(beta)


def test_fit_needs_residuals():
    assert fit_noise(np.ones(3), np.ones(3)) is None
    flat = fit_noise(np.ones(100), np.ones(100))
    assert flat is not None
    assert flat.beta == 0.0


@pytest.mark.parametrize(
    ("mode", "moves_sigma", "moves_beta"),
    [("robust", True, True), ("off", True, False), ("paper", False, False)],
)
def test_what_each_mode_fits(mode, moves_sigma, moves_beta):
    rng = np.random.default_rng(3)
    noise = OnlineNoise(mode, 0.7, 2.0, True)
    before = noise.model
    c = rng.uniform(0, 1, 3000)
    for _ in range(6):
        noise.add(c, rng.standard_normal(3000) * NoiseModel(1.5, 4.0).sigma_px(c))
    assert (noise.model.sigma0_px != before.sigma0_px) == moves_sigma
    assert (noise.model.beta > before.beta + 1.0) == moves_beta
    again = OnlineNoise(mode, 0.7, 2.0, True)
    again.restore(noise.state())
    assert again.model == noise.model


def test_a_fit_moves_the_model_half_of_the_way():
    rng = np.random.default_rng(3)
    c = rng.uniform(0, 1, 3000)
    residual = rng.standard_normal(3000) * NoiseModel(1.5, 4.0).sigma_px(c)
    fitted, noise = fit_noise(c, residual), OnlineNoise("robust", 0.5, 2.0, True)
    noise.add(c, residual)
    assert noise.model.beta == pytest.approx(0.5 * fitted.beta), "it starts at 0"
    assert noise.model.sigma0_px == pytest.approx(np.sqrt(0.5 * fitted.sigma0_px))


def test_what_is_not_fitted_is_as_set_after_a_restart_too():
    state = OnlineNoise("robust", 0.3, 7.0, False).state()
    for mode, fit in (("paper", True), ("robust", False)):
        noise = OnlineNoise(mode, 2.0, 3.0, fit)
        noise.restore(state)
        assert replace(noise.model, huber_px=None) == NoiseModel(2.0, 3.0)
    noise = OnlineNoise("off", 2.0, 3.0, True)
    noise.restore(state)
    assert noise.model == NoiseModel(0.3, 0.0)


def test_the_papers_loss_does_not_know_the_weights():
    assert OnlineNoise("paper", 0.5, 2.0, True).model.huber_px == pytest.approx(0.5 * 1.345)
    assert OnlineNoise("robust", 0.5, 2.0, True).model.huber_px is None


def test_fit_can_be_switched_off():
    noise = OnlineNoise("robust", 0.7, 2.0, False)
    noise.add(np.linspace(0, 1, 500), np.linspace(5, 0, 500))
    assert noise.model == NoiseModel(0.7, 2.0)


def test_localisation_variance_by_hand():
    # 2 grey levels of noise, 16 independent values of gradient energy 100: variance 4 / 1600 = 0.05^2.
    assert np.allclose(localisation_variance_px2(cues(forward_backward_px=np.full(4, 0.12))), 0.13**2)
    # The codec's confidence 1 - tanh(30 * 0.04) stands for errors of 0.04 * 255 grey levels.
    doubted = cues(pixel_confidence=np.full(4, 1.0 - np.tanh(1.2)), gradient_grey2=np.full(4, 25.0))
    assert np.allclose(localisation_variance_px2(doubted), 10.2**2 / (16 * 25))
    # The displacement head alone says 3 px.
    sure = cues(keypoint_confidence=np.full(4, 0.25), gradient_grey2=np.full(4, 1e12))
    assert np.allclose(localisation_variance_px2(sure), 9.0, atol=1e-5)


def test_geometric_confidence_by_hand():
    calm = cues(gradient_grey2=np.full(4, 1e12))
    # 0 at 5 px; with 0.4 px of drift v = 0.16, and c = 1 - log(1 + 0.16 / 0.09) / log(1 + 25 / 0.09).
    drifted = geometric_confidence(replace(calm, drift_px2=np.array([0.0, 0.16, 25.0, 100.0])))
    assert np.allclose(drifted, [1.0, 1 - 1.02165 / 5.63040, 0.0, 0.0], atol=1e-5)


def test_doubt_adds_to_the_error_of_tracking_where_beta_is_its_own_unit():
    v = np.array([0.0, 0.01, 0.09, 1.0])
    c = geometric_confidence(replace(cues(gradient_grey2=np.full(4, 1e12)), drift_px2=v))
    model = NoiseModel(0.3, float(np.log(1 + 25 / 0.09)))
    assert np.allclose(model.sigma_px(c) ** 2, 0.09 + v, atol=1e-6)


def test_a_strong_edge_is_trusted_more_than_a_weak_one_under_the_same_noise():
    c = geometric_confidence(
        cues(2, gradient_grey2=np.array([400.0, 4.0]), pixel_confidence=np.array([0.3, 0.3]))
    )
    assert c[0] > c[1]


def test_every_cue_lowers_the_confidence():
    calm = geometric_confidence(cues())
    for changes in (
        {"forward_backward_px": np.full(4, 1.0)},
        {"photometric_grey": np.full(4, 30.0)},
        {"pixel_confidence": np.full(4, 0.1)},
        {"keypoint_confidence": np.full(4, 0.5)},
        {"gradient_grey2": np.full(4, 1.0)},
        {"drift_px2": np.full(4, 0.1)},
    ):
        assert np.all(geometric_confidence(cues(**changes)) < calm)


def test_modes_of_confidence():
    rng = np.random.default_rng(0)
    given = cues(
        pixel_confidence=np.array([0.1, 0.4, 0.9, 0.6]), forward_backward_px=np.array([0, 1, 2, 3.0])
    )
    robust = observation_confidence("robust", given, rng)
    assert np.all(observation_confidence("off", given, rng) == 1.0)
    assert np.allclose(observation_confidence("paper", given, rng), given.pixel_confidence)
    assert np.allclose(observation_confidence("constant", given, rng), robust.mean())
    assert np.allclose(observation_confidence("inverted", given, rng), 1 - robust)
    shuffled = [observation_confidence("shuffled", given, rng) for _ in range(5)]
    assert all(np.allclose(np.sort(s), np.sort(robust)) for s in shuffled)
    assert any(not np.allclose(s, robust) for s in shuffled)


def test_odd_confidence_gives_finite_confidence():
    odd = cues(
        pixel_confidence=np.array([-1.0, 2.0, 0.0, 1.0]),
        keypoint_confidence=np.array([0.0, 5.0, -3.0, 1.0]),
        gradient_grey2=np.array([0.0, 1e9, 1.0, 2.0]),
    )
    c = geometric_confidence(odd)
    assert np.isfinite(c).all()
    assert np.all((c >= 0) & (c <= 1))
