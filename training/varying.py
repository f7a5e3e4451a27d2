"""Starting a network of variable rate from one of fixed rate, so that it computes the same at first.

The values of the latent are turned into an order in which the first ones tell most about flat blocks, which
will send no others. The values that are new carry what the trained network gets wrong about blocks with
detail: its largest errors' directions, as the block transform would send them.
"""

import torch
from torch import Tensor, nn

from semcast.common.errors import ConfigError
from semcast.common.nets.blocks import Stage
from semcast.common.nets.decoder import Decoder
from semcast.common.nets.detail import demand_of, detail_of
from semcast.common.nets.encoder import Encoder
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.allocation import LEVELS, MAX_VALUES, levels_for
from semcast.common.phy.slots import BLOCK_PX, LATENT_CHANNELS

#: Share of blocks, by detail, that are flat.
_FLAT_SHARE = 0.6
#: Power of new values against that of old ones.
_NEW_POWER = 0.7


class Observations:
    """Blocks of training images with what a network of fixed rate makes of them."""

    def __init__(self) -> None:
        self._latents: list[Tensor] = []
        self._errors: list[Tensor] = []
        self._details: list[Tensor] = []

    def add(self, x: Tensor, latent: Tensor, x_hat: Tensor) -> None:
        """Add the blocks of a batch.

        Args:
            x: ``(B, 3, H, W)`` in [0, 1], of images of 8 bits.
            latent: ``(B, 94, H/16, W/16)``.
            x_hat: ``(B, 3, H, W)`` decoded.
        """
        pixels = (x * 255.0).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        self._details += [torch.from_numpy(detail_of(image)).flatten() for image in pixels]
        errors = nn.functional.pixel_unshuffle(x - x_hat.float(), BLOCK_PX)
        self._latents.append(_rows(latent))
        self._errors.append(_rows(errors))

    def order(self) -> Tensor:
        """Return the orthonormal ``(94, 94)`` whose columns lead from old values to ordered ones."""
        latents = torch.cat(self._latents)[self._flat()]
        _, vectors = torch.linalg.eigh(latents.T @ latents / len(latents))
        ordered: Tensor = vectors.flip(1)
        return ordered

    def missing(self) -> tuple[Tensor, Tensor]:
        """Return the directions ``(768, C)`` that errors of blocks with detail have, and their variance."""
        errors = torch.cat(self._errors)[~self._flat()]
        variances, vectors = torch.linalg.eigh(errors.T @ errors / len(errors))
        num_new = MAX_VALUES - LATENT_CHANNELS
        least = 1e-4 * float(variances[-1])  # of few blocks most directions have none
        return vectors.flip(1)[:, :num_new], variances.flip(0)[:num_new].clamp_min(least)

    def power(self) -> float:
        """Mean square of the old values of blocks with detail."""
        return float(torch.cat(self._latents)[~self._flat()].square().mean())

    def scale(self) -> float:
        """Factor that gives the values that are sent, by the usual rule, the power all values had.

        Flat blocks send few values, the loudest: the frame would be louder, and the carrier weaker beside it.
        """
        latents = torch.cat(self._latents)
        levels = levels_for(demand_of(torch.cat(self._details).numpy()), LATENT_CHANNELS * len(latents))
        values = torch.tensor(LEVELS)[torch.from_numpy(levels).long()]
        squares = (latents @ self.order()).square()
        of_old = (squares * (torch.arange(LATENT_CHANNELS) < values[:, None])).sum()
        of_new = _NEW_POWER * self.power() * (values - LATENT_CHANNELS).clamp_min(0).sum()
        return float((squares.mean() * values.sum() / (of_old + of_new)).sqrt())

    def _flat(self) -> Tensor:
        details = torch.cat(self._details)
        return details <= details.quantile(_FLAT_SHARE)


def _rows(planes: Tensor) -> Tensor:
    return planes.detach().float().cpu().permute(0, 2, 3, 1).flatten(0, 2)


@torch.no_grad()
def vary(fixed: Transceiver, variable: Transceiver, seen: Observations) -> None:
    """Make a freshly built network of variable rate compute what one of fixed rate computes, in place.

    Args:
        fixed: Trained.
        variable: Of the same sizes, or with fewer units: the last ones are taken, and it computes nearly the
            same.
        seen: Training images through ``fixed``.

    Raises:
        ConfigError: The networks are not of the 3dcsc kind and the same widths.
    """
    theirs, ours = _last_units(fixed, variable), variable.state_dict()
    # What differs are the layers that hold values of the latent, and the one that is told how many are sent.
    own = {name for name in ours if name not in theirs or theirs[name].shape != ours[name].shape}
    layers = {name.rpartition(".")[0] for name in own}
    expected = {
        "encoder.linear.transform",
        "encoder.linear.mix",
        "encoder.head",
        "encoder.share",
        "decoder.linear",
        "decoder.linear.unmix",
        "decoder.linear.transform",
        "decoder.stem",
        "decoder.adapt_head",
        "confidence.start",
    }
    if layers != expected or not theirs.keys() <= ours.keys():
        raise ConfigError(
            "grow_from must hold a 3dcsc network of fixed rate and the same widths, got one in which "
            f"{sorted(layers ^ expected)[0] if layers ^ expected else 'a layer'} differs"
        )
    for name, weight in theirs.items():
        if name not in own:
            ours[name].copy_(weight)
    assert isinstance(fixed.encoder, Encoder)
    assert isinstance(variable.encoder, Encoder)
    assert isinstance(fixed.decoder, Decoder)
    assert isinstance(variable.decoder, Decoder)
    order, (directions, variances) = seen.order(), seen.missing()
    power = variances.sqrt() / variances.sqrt().mean() * _NEW_POWER * seen.power()
    amplitude = (power / variances).sqrt()
    _vary_encoder(fixed.encoder, variable.encoder, order, amplitude[:, None] * directions.T)
    _vary_decoder(fixed.decoder, variable.decoder, order, directions / amplitude, power.log())
    start = variable.confidence.start
    assert isinstance(start, nn.Conv2d)
    _set_received(start, fixed.confidence.start.weight, order)  # type: ignore[arg-type,union-attr]
    _scale_latent(variable.encoder, variable.decoder, start, seen.scale())


def _last_units(fixed: Transceiver, variable: Transceiver) -> dict[str, Tensor]:
    """Return the weights of a network without the first units of stages that have fewer in the other one."""
    state, others = fixed.state_dict(), dict(variable.named_modules())
    for name, stage in fixed.named_modules():
        other = others.get(name)
        if not (isinstance(stage, Stage) and isinstance(other, Stage)):
            continue
        num_dropped = max(0, len(stage.units) - len(other.units))
        for key in [key for key in state if key.startswith(f"{name}.units.")]:
            place, _, rest = key.removeprefix(f"{name}.units.").partition(".")
            weight = state.pop(key)
            if int(place) >= num_dropped:
                state[f"{name}.units.{int(place) - num_dropped}.{rest}"] = weight
    return state


def _vary_encoder(old: Encoder, new: Encoder, order: Tensor, added: Tensor) -> None:
    count = LATENT_CHANNELS
    new.linear.mix.weight.zero_()
    new.linear.mix.weight[:count, :count, 0, 0] = order.T @ old.linear.mix.weight[:, :, 0, 0]
    new.linear.mix.weight[count:, count:, 0, 0] = torch.eye(MAX_VALUES - count)
    new.linear.transform.weight[:count] = old.linear.transform.weight
    new.linear.transform.weight[count:, :, 0, 0] = added
    _bias(new.linear.transform).zero_()[:count] = _bias(old.linear.transform)
    # First what is added to the values, behind it the log gains of the coefficients.
    new.head.weight.zero_()
    _bias(new.head).zero_()
    new.head.weight[:count, :, 0, 0] = order.T @ old.head.weight[:count, :, 0, 0]
    _bias(new.head)[:count] = order.T @ _bias(old.head)[:count]
    new.head.weight[MAX_VALUES : MAX_VALUES + count] = old.head.weight[count:]
    _bias(new.head)[MAX_VALUES : MAX_VALUES + count] = _bias(old.head)[count:]


def _vary_decoder(old: Decoder, new: Decoder, order: Tensor, added: Tensor, log_power: Tensor) -> None:
    count = LATENT_CHANNELS
    new.linear.unmix.weight.zero_()
    new.linear.unmix.weight[:count, :count, 0, 0] = old.linear.unmix.weight[:, :, 0, 0] @ order
    new.linear.unmix.weight[count:, count:, 0, 0] = torch.eye(MAX_VALUES - count)
    _bias(new.linear.unmix).zero_()[:count] = _bias(old.linear.unmix)
    new.linear.log_power[:count] = old.linear.log_power
    new.linear.log_power[count:] = log_power
    new.linear.transform.weight[:, :count] = old.linear.transform.weight
    new.linear.transform.weight[:, count:, 0, 0] = added
    _set_received(new.stem, old.stem.weight, order)
    new.adapt_head.weight.zero_()
    _bias(new.adapt_head).zero_()
    for start, part in ((0, slice(0, count)), (MAX_VALUES, slice(count, 2 * count))):
        new.adapt_head.weight[start : start + count] = old.adapt_head.weight[part]
        _bias(new.adapt_head)[start : start + count] = _bias(old.adapt_head)[part]


def _set_received(layer: nn.Conv2d, weight: Tensor, order: Tensor) -> None:
    """Set a layer that reads what is received: ordered values, no new ones, SNR and shrink factor."""
    count = LATENT_CHANNELS
    layer.weight.zero_()
    layer.weight[:, :count] = torch.einsum("oikl,ij->ojkl", weight[:, :count], order)
    layer.weight[:, MAX_VALUES : MAX_VALUES + 2] = weight[:, count:]


def _scale_latent(encoder: Encoder, decoder: Decoder, start: nn.Conv2d, factor: float) -> None:
    encoder.linear.mix.weight.mul_(factor)
    encoder.head.weight[:MAX_VALUES].mul_(factor)
    _bias(encoder.head)[:MAX_VALUES].mul_(factor)
    for layer in (decoder.linear.unmix, decoder.stem, start):
        layer.weight[:, :MAX_VALUES].div_(factor)


def _bias(layer: nn.Conv2d) -> Tensor:
    assert layer.bias is not None
    return layer.bias
