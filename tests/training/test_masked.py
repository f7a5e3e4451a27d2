import pytest
import torch

from semcast.common.errors import ConfigError
from semcast.common.nets.mae import build_mae
from semcast.common.nets.registry import build
from semcast.common.nets.vit import VitSizes
from semcast.training.masked import masked_image_loss

SMALL = VitSizes(dim=32, heads=4, encoder_depth=1, decoder_depth=1, confidence_channels=8)


def seeded(k=0):
    return torch.Generator().manual_seed(k)


def test_only_hidden_patches_count():
    torch.manual_seed(0)
    model = build_mae(SMALL)
    with torch.no_grad():
        model.decoder.head.weight.zero_()
        model.decoder.head.bias.zero_()  # every pixel becomes 0.5
    # 2 x 2 patches of 16 px, one visible: patches 0.1, 0.2, 0.3 and 0.4 off grey.
    x = torch.full((1, 3, 32, 32), 0.5)
    errors = torch.tensor([0.1, 0.2, 0.3, 0.4])
    for k in range(4):
        x[:, :, 16 * (k // 2) :][:, :, :16, 16 * (k % 2) :][..., :16] += errors[k]
    kept = torch.rand(1, 4, generator=seeded()).argsort(dim=1)[0, 0]
    loss, _ = masked_image_loss(model, x, 0.75, seeded())
    hidden = errors[torch.arange(4) != kept]
    assert loss.item() == pytest.approx(hidden.square().mean().item(), rel=1e-4)


def test_the_encoder_does_not_see_what_is_hidden():
    torch.manual_seed(0)
    model = build_mae(SMALL)
    x = torch.rand(1, 3, 32, 32, generator=seeded(1))
    kept = torch.rand(1, 4, generator=seeded()).argsort(dim=1)[0, 0].item()
    x.requires_grad_(True)
    seen = []
    model.encoder.trunk.blocks[-1].register_forward_hook(lambda layer, given, out: seen.append(out))
    masked_image_loss(model, x, 0.75, seeded())
    (seen[0] * torch.arange(32.0)).sum().backward()
    row, column = 16 * (kept // 2), 16 * (kept % 2)
    outside = x.grad.clone()
    assert outside[:, :, row : row + 16, column : column + 16].abs().max() > 0
    outside[:, :, row : row + 16, column : column + 16] = 0
    assert outside.abs().max() == 0


def test_images_need_not_be_square():
    loss, logs = masked_image_loss(build_mae(SMALL), torch.rand(2, 3, 64, 80), 0.75, seeded())
    loss.backward()
    assert torch.isfinite(loss)
    assert set(logs) == {"mse", "masked"}


def test_another_architecture_is_refused():
    with pytest.raises(ConfigError, match="pretrain_share must be 0"):
        masked_image_loss(build("vit"), torch.rand(1, 3, 32, 32), 0.5, seeded())
