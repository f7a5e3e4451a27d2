import numpy as np
import pytest
import torch

from semcast.common.errors import ConfigError
from semcast.common.nets.registry import build
from semcast.common.nets.transceiver import Sizes, build_3dcsc, build_variable_3dcsc
from semcast.training.klt import LinearLink, block_statistics, linear_link, start_from_klt

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)


def smooth_photos():
    rng = np.random.default_rng(0)
    row, column = np.mgrid[0:192, 0:192] / 192.0
    photos = []
    for _ in range(6):
        waves = [
            rng.uniform(10, 40) * np.sin(2 * np.pi * (rng.uniform(-6, 6) * row + rng.uniform(-6, 6) * column))
            for _ in range(4)
        ]
        tint = rng.uniform(0.6, 1.2, size=3)
        photos.append(np.clip((88 + sum(waves))[:, :, None] * tint, 0, 255).astype(np.uint8))
    return photos


def test_statistics_of_constant_images_are_their_colour():
    image = np.full((65, 67, 3), (0, 128, 255), np.uint8)
    mean, covariance = block_statistics([image])
    np.testing.assert_allclose(mean[:256], -0.5, atol=1e-6)
    np.testing.assert_allclose(mean[512:], 0.5, atol=1e-6)
    np.testing.assert_allclose(covariance, 0.0, atol=1e-6)


def test_images_without_a_block_are_refused():
    with pytest.raises(ValueError, match="whole 16x16 block"):
        block_statistics([np.zeros((16, 16, 3), np.uint8)])


@pytest.mark.parametrize(
    ("make", "psnr_db"),
    [
        (lambda: build_3dcsc(TINY), 20.0),
        (lambda: build_variable_3dcsc(TINY), 20.0),
        (lambda: build("vit"), 20.0),
        (lambda: build("mae"), 20.0),
    ],
    ids=["3dcsc", "3dcsc-vr", "vit", "mae"],
)
@pytest.mark.parametrize("flag", [0.0, 1.0])
def test_before_any_training_the_link_already_carries_the_image(make, psnr_db, flag):
    torch.manual_seed(0)
    photos = smooth_photos()
    model = make().eval()
    start_from_klt(model, photos, torch.Generator().manual_seed(0))
    x = torch.from_numpy(photos[0][::2, ::2].copy()).permute(2, 0, 1)[None] / 255.0
    snr_db, is_qam = torch.full((1,), 20.0), torch.full((1,), flag)
    with torch.inference_mode():
        plane = torch.full((1, 1, 6, 6), 20.0)
        values = torch.full((1, 1, 6, 6), 94) if model.is_variable else None
        latent = model.latent(x, snr_db, is_qam, values)
        symbols = model.transmit(latent, is_qam, values) * (100 / 101)
        x_hat, _ = model.receive(symbols, plane, is_qam, values)
    assert -10 * torch.log10((x_hat - x).square().mean()) > psnr_db


def test_the_linear_link_returns_what_its_coefficients_hold():
    link = linear_link(smooth_photos(), 40, torch.Generator().manual_seed(0))
    np.testing.assert_allclose(link.unmix @ link.mix, np.eye(40), atol=1e-6)
    np.testing.assert_allclose(link.analysis @ link.synthesis, np.eye(40), atol=1e-6)
    assert link.power.mean() == pytest.approx(1.0)
    rms = np.sqrt(np.mean((link.mix**2) @ link.power))
    assert rms == pytest.approx(0.9, rel=1e-3)
    # Mixed, each coefficient is in many values; apart, in its own.
    assert np.abs(link.mix).max() < 0.7 * np.linalg.norm(link.mix, axis=0).max()
    apart = linear_link(smooth_photos(), 40, None)
    np.testing.assert_allclose(apart.mix, 0.9 * np.eye(40))


def test_wiener_gains_by_hand():
    # Half the latent for one coefficient each, 0 dB: noise 1/2 a coefficient, shrunk by 1/2 on the way.
    eye = np.eye(47)
    link = LinearLink(eye, eye, np.ones(47), eye, eye, eye)
    np.testing.assert_allclose(link.wiener(0.0), 1.0 / 1.5 * 2.0)
    np.testing.assert_allclose(link.wiener(10.0), 1.0 / 1.05 * 1.1)


def test_an_architecture_without_a_linear_heart_is_refused():
    with pytest.raises(ConfigError, match="start must be 'random'"):
        start_from_klt(build("cnn"), smooth_photos(), torch.Generator())
