import pytest
import torch

from semcast.training.muon import Muon, orthogonalise


@pytest.mark.parametrize("shape", [(8, 30), (30, 8), (12, 12)])
def test_singular_values_come_close_to_one(shape):
    matrices = torch.randn(3, *shape, generator=torch.Generator().manual_seed(0))
    values = torch.linalg.svdvals(orthogonalise(matrices))
    assert values.max().item() < 1.35
    assert values.median().item() > 0.6


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
    weight = torch.nn.Parameter(torch.ones(3, 3))
    Muon([weight], lr=0.1).step()
    torch.testing.assert_close(weight.data, torch.ones(3, 3))
