"""A network of variable rate starts as the one of fixed rate it came from, and can learn with what is new."""

import pytest
import torch

from semcast.common.errors import ConfigError
from semcast.common.nets.transceiver import Sizes, build_3dcsc, build_variable_3dcsc
from semcast.common.phy.allocation import MAX_VALUES
from semcast.training.varying import Observations, vary

SIZES = Sizes((8, 12, 16), (1, 1, 1), (1, 1, 1), 8)
FIXED = torch.full((2, 1, 4, 4), 94)


def trained():
    """A network none of whose weights are left at zero, as after training."""
    torch.manual_seed(0)
    model = build_3dcsc(SIZES).eval()
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.05 * torch.randn_like(weight))
    return model


def images(count=2, seed=3):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 8, 8, generator=generator)
    x = torch.nn.functional.interpolate(coarse, size=64, mode="bicubic").clamp(0, 1)
    x[:, :, :32] += 0.2 * torch.rand(count, 3, 32, 64, generator=generator)
    return (x.clamp(0, 1) * 255).round() / 255


def through(model, x, values=None):
    snr_db, is_qam = torch.tensor([4.0, 11.0]), torch.zeros(2)
    plane = torch.full((2, 1, 4, 4), 8.0)
    latent = model.latent(x, snr_db, is_qam, values)
    if values is None:
        x_hat, features = model.receive(0.8 * model.transmit(latent, is_qam), plane, is_qam)
    else:
        shrink = torch.full_like(latent, 10**0.8 / (1 + 10**0.8))
        x_hat, features = model.receive_blocks(0.8 * model.send_blocks(latent, values), shrink, values)
    return latent, x_hat, *model.judge(features, x_hat)


def seen_by(model, count):
    """What is seen of a network on so many pairs of images, of 32 blocks each."""
    seen = Observations()
    with torch.no_grad():
        for seed in range(count):
            x = images(seed=seed)
            latent, x_hat, *_ = through(model, x)
            seen.add(x, latent, x_hat)
    return seen


@pytest.fixture(scope="module")
def pair():
    fixed = trained()
    seen = seen_by(fixed, 40)
    torch.manual_seed(1)
    variable = build_variable_3dcsc(SIZES).eval()
    vary(fixed, variable, seen)
    return fixed, variable, seen


def test_with_as_many_values_everywhere_it_computes_the_same(pair):
    fixed, variable, seen = pair
    # The carrier takes a little of the latent, another little in another order of its values.
    with torch.no_grad():
        x = images()
        theirs, ours = through(fixed, x), through(variable, x, FIXED)
    ordered = seen.scale() * torch.einsum("ij,bihw->bjhw", seen.order(), theirs[0])
    torch.testing.assert_close(ours[0][:, :94], ordered, atol=1e-4, rtol=1e-4)
    spread = float(theirs[1].std())
    assert float((ours[1] - theirs[1]).square().mean().sqrt()) < 0.05 * spread
    for our_map, their_map in zip(ours[2:], theirs[2:], strict=True):
        assert float((our_map - their_map).abs().mean()) < 0.05


def test_the_first_values_of_flat_blocks_hold_most_of_their_energy(pair):
    fixed, variable, _ = pair
    with torch.no_grad():
        flat = images(seed=50)[:, :, 32:].repeat(1, 1, 2, 1)
        theirs, ours = through(fixed, flat)[0], through(variable, flat, FIXED)[0]
    before, after = (latent.square().sum(dim=(0, 2, 3)) for latent in (theirs, ours))
    assert after[:24].sum() / after[:94].sum() > before[:24].sum() / before.sum() + 0.1


def test_what_is_new_has_a_gradient(pair):
    _, variable, _ = pair
    values = torch.full((2, 1, 4, 4), MAX_VALUES)
    through(variable, images(), values)[1].square().mean().backward()
    gradients = {name: weight.grad for name, weight in variable.named_parameters()}
    for name, part in (
        ("encoder.linear.transform.weight", slice(94, None)),
        ("decoder.linear.transform.weight", (slice(None), slice(94, None))),
        ("decoder.stem.weight", (slice(None), slice(94, MAX_VALUES))),
        ("decoder.stem.weight", (slice(None), slice(-1, None))),
        ("encoder.share.weight", slice(None)),
    ):
        assert gradients[name][part].abs().sum() > 0, name
    variable.zero_grad()


def test_observations_order_and_directions_are_orthonormal(pair):
    _, _, seen = pair
    order, (directions, variances) = seen.order(), seen.missing()
    torch.testing.assert_close(order.T @ order, torch.eye(94), atol=1e-4, rtol=0)
    assert directions.shape == (768, MAX_VALUES - 94)
    torch.testing.assert_close(directions.T @ directions, torch.eye(MAX_VALUES - 94), atol=1e-4, rtol=0)
    assert (variances[:-1] >= variances[1:]).all()


def test_networks_of_other_sizes_are_refused(pair):
    fixed, _, seen = pair
    other = build_variable_3dcsc(Sizes((8, 12, 20), (1, 1, 1), (1, 1, 1), 8))
    with pytest.raises(
        ConfigError, match="grow_from must hold a 3dcsc network of fixed rate and the same widths"
    ):
        vary(fixed, other, seen)


def test_a_network_with_fewer_units_takes_the_last_ones():
    fixed = build_3dcsc(Sizes((8, 12, 16), (1, 1, 3), (1, 1, 1), 8)).eval()
    with torch.no_grad():
        for weight in fixed.parameters():
            weight.add_(0.05 * torch.randn_like(weight))
        for weight in fixed.encoder.stage16.units[0].parameters():
            weight.zero_()  # it adds nothing: without it the network computes the same
    seen = seen_by(fixed, 12)
    variable = build_variable_3dcsc(Sizes((8, 12, 16), (1, 1, 2), (1, 1, 1), 8)).eval()
    vary(fixed, variable, seen)
    with torch.no_grad():
        x = images()
        theirs, ours = through(fixed, x)[0], through(variable, x, FIXED)[0]
    ordered = seen.scale() * torch.einsum("ij,bihw->bjhw", seen.order(), theirs)
    torch.testing.assert_close(ours[:, :94], ordered, atol=1e-4, rtol=1e-4)
