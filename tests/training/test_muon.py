import pytest
import torch

from semcast.training import muon
from semcast.training.muon import Muon, orthogonalise


@pytest.mark.parametrize("shape", [(8, 30), (30, 8), (12, 12)])
def test_singular_values_come_close_to_one(shape):
    matrices = torch.randn(3, *shape, generator=torch.Generator().manual_seed(0))
    values = torch.linalg.svdvals(orthogonalise(matrices))
    assert values.max().item() < 1.35
    assert values.median().item() > 0.6


@pytest.mark.parametrize("has_bfloat16", [True, False])
def test_bfloat16_is_used_where_the_hardware_has_it(monkeypatch, has_bfloat16):
    monkeypatch.setattr(muon, "has_fast_bfloat16", lambda: has_bfloat16)
    nearest = orthogonalise(torch.randn(3, 8, 30, generator=torch.Generator().manual_seed(0)))
    assert nearest.dtype == torch.float32
    assert torch.equal(nearest, nearest.bfloat16().float()) == has_bfloat16


def test_a_matrix_of_a_stack_comes_out_as_it_would_alone():
    matrices = torch.randn(3, 6, 10, generator=torch.Generator().manual_seed(0))
    alone = orthogonalise(100.0 * matrices[1:2])
    torch.testing.assert_close(orthogonalise(matrices)[1:2], alone, atol=0.05, rtol=0.05)


def test_the_scale_of_a_gradient_does_not_matter():
    matrix = torch.randn(1, 6, 10, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(orthogonalise(matrix), orthogonalise(1000 * matrix), atol=0.05, rtol=0.05)


def test_it_finds_the_least_of_a_quadratic():
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(6, 4, 3, 3, generator=generator)
    weight = torch.nn.Parameter(torch.zeros_like(target))
    optimiser = Muon([weight], lr=0.05)
    first = (weight - target).square().sum().item()
    for step in range(200):
        optimiser.param_groups[0]["lr"] = 0.05 * (1 - step / 200)
        optimiser.zero_grad()
        loss = (weight - target).square().sum()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.1 * first


def test_weights_without_gradient_are_left_alone():
    frozen, weight = (torch.nn.Parameter(torch.ones(3, 3)) for _ in range(2))
    weight.grad = torch.eye(3)
    Muon([{"params": [frozen]}, {"params": [weight]}], lr=0.1).step()
    torch.testing.assert_close(frozen.data, torch.ones(3, 3))
    assert (weight.diagonal() < 1.0).all(), "the group after it is trained"


def test_an_update_is_the_nearest_orthogonal_matrix_of_the_nesterov_mean(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "semcast.training.muon.orthogonalise", lambda matrices: seen.append(matrices) or matrices
    )
    weight = torch.nn.Parameter(torch.full((4, 1), 10.0))
    optimiser = Muon([weight], lr=0.1, momentum=0.75, weight_decay=0.5)
    for gradient in (4.0, 8.0):
        weight.grad = torch.full((4, 1), gradient)
        optimiser.step()
    # Momentum 0.25 * 4 = 1, then 0.75 * 1 + 0.25 * 8 = 2.75; the gradient itself counts a quarter.
    means = [0.25 * 4.0 + 0.75 * 1.0, 0.25 * 8.0 + 0.75 * 2.75]
    assert [matrices.unique().tolist() for matrices in seen] == [[mean] for mean in means]
    # Four rows a column: twice the step. The decay takes 0.5 * 0.1 of the weight before it.
    after = 10.0
    for mean in means:
        after = 0.95 * after - 2.0 * 0.1 * mean
    torch.testing.assert_close(weight.data, torch.full((4, 1), after))


def test_the_loss_of_a_closure_is_returned():
    weight = torch.nn.Parameter(torch.ones(3, 3))
    assert Muon([weight], lr=0.1).step(lambda: 2.5) == 2.5
