"""A trained transceiver arranged for inference: fewer and cheaper passes over memory, the same figures.

On a CPU the convolutions of 3DC-SC take less than half of the time of its plain modules; the rest is
pixel-(un)shuffles, casts and activations. Here pixels stay in rows ``(H, W, C)`` from the camera's buffer to
the last layer: weights are cast once, their channels are put into the order in which (un)folding is a copy of
long runs, activations happen in place, and no picture is built where only its folded form is used.

Where convolutions are of eight-bit integers, those that carry the picture itself are not: the linear
transform, which takes a fiftieth of the work, and the layers whose sum with it is sent or shown.
"""

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, logsigmoid

from semcast.common.nets.blocks import (
    HIDDEN_SLOPE,
    ChannelAttention,
    Stage,
    condition_vector,
    normalise_snr_db,
)
from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.decoder import Decoder
from semcast.common.nets.encoder import Encoder
from semcast.common.nets.int8 import Int8Conv
from semcast.common.nets.linear import MAX_LOG_GAIN, BlockSynthesis
from semcast.common.nets.modulation import (
    analog_values,
    demodulate,
    effective_snr_db,
    shrink_of,
)
from semcast.common.nets.packing import blocks_arrived, sent_mask, share_plane, unpack
from semcast.common.nets.transceiver import Transceiver

#: Side of the pixel groups the finest convolutions see, and how many of those make a block.
_FOLD, _GROUPS = 4, 4


class InferenceNet(Protocol):
    """What a codec needs of a network."""

    def latent(self, pixels: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None) -> Tensor:
        """Map ``(H, W, 3)`` uint8, sides multiples of 16, to the float latent ``(1, C, H/16, W/16)``."""

    def decode(
        self, y_rx: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Decode equalised symbols.

        Args:
            y_rx: ``(1, 94, h, w)`` float32.
            snr_db: ``(1, 1, h, w)`` effective SNR of each slot in dB.
            is_qam: ``(1,)``.
            values: ``(1, 1, h, w)`` how many values each block sends, where the rate is variable.

        Returns:
            Image ``(16 h, 16 w, 3)`` uint8; confidence in [0, 1] and expected keypoint displacement in
            pixels, both ``(16 h, 16 w)`` float32.
        """


def inference_net(model: Transceiver, dtype: torch.dtype) -> InferenceNet:
    """Arrange a network for inference.

    Args:
        model: In evaluation mode, on the device it will run on.
        dtype: Of convolutions: bfloat16, float32, or int8 where it can be arranged (``can_arrange``).
    """
    return ArrangedNet(model, dtype) if can_arrange(model) else PlainNet(model, dtype)


def can_arrange(model: Transceiver) -> bool:
    """Tell whether a network is 3DC-SC, of any size."""
    parts = (type(model.encoder), type(model.decoder), type(model.confidence))
    return parts == (Encoder, Decoder, ConfidenceBranch)


class PlainNet:
    """Any transceiver, through its own modules."""

    def __init__(self, model: Transceiver, dtype: torch.dtype) -> None:
        self._model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._half = dtype != torch.float32
        for module in model.modules():
            # Autocast would cast these for every frame anew.
            if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)) and self._half:
                module.to(dtype)

    def latent(self, pixels: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None) -> Tensor:
        """See ``InferenceNet``."""
        with torch.autocast(pixels.device.type, torch.bfloat16, enabled=self._half):
            # (1, 3, H, W) in channels_last: the memory of the image as it is.
            x = pixels[None].permute(0, 3, 1, 2).float().mul_(1.0 / 255.0)
            latent: Tensor = self._model.latent(x, snr_db, is_qam, values)
        return latent

    def decode(
        self, y_rx: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See ``InferenceNet``."""
        with torch.autocast(y_rx.device.type, torch.bfloat16, enabled=self._half):
            x_hat, features = self._model.receive(y_rx, snr_db, is_qam, values)
            logit, displacement = self._model.judge(features, x_hat)
        pixels: Tensor = x_hat[0].float().clamp_(0.0, 1.0).mul_(255.0).round_().to(torch.uint8)
        return pixels.permute(1, 2, 0).contiguous(), torch.sigmoid(logit[0, 0].float()), displacement[0, 0]


def _rows(x: Tensor) -> Tensor:
    """View ``(1, C, h, w)`` channels_last as ``(h, w, C)``."""
    return x[0].permute(1, 2, 0)


def _image(rows: Tensor) -> Tensor:
    """View ``(h, w, C)`` as ``(1, C, h, w)`` channels_last."""
    # Batch first, then permuted: the batch axis gets a stride by which torch knows channels_last.
    return rows[None].permute(0, 3, 1, 2)


def _gather(rows: Tensor, side: int) -> Tensor:
    """Fold ``(h s, w s, C)`` into ``(h, w, s s C)``, channels in the order row, column, channel."""
    height, width, channels = rows.shape
    grid = rows.reshape(height // side, side, width // side, side * channels)
    return grid.transpose(1, 2).reshape(height // side, width // side, side * side * channels)


def _spread(rows: Tensor, side: int) -> Tensor:
    """Invert ``_gather``."""
    height, width, channels = rows.shape
    grid = rows.reshape(height, width, side, channels // side).transpose(1, 2)
    return grid.reshape(height * side, width * side, channels // (side * side))


def _fold_order() -> Tensor:
    """Return, for each channel of RGB gathered by 4, the same value's channel of ``PixelUnshuffle(4)``."""
    return _order(_FOLD, lambda rows: _gather(rows, _FOLD))


def _block_order() -> Tensor:
    """Return the same for 16x16 RGB blocks gathered by 4 and by 4 again."""
    return _order(_FOLD * _GROUPS, lambda rows: _gather(_gather(rows, _FOLD), _GROUPS))


def _order(side: int, gather: Callable[[Tensor], Tensor]) -> Tensor:
    picture = torch.arange(3 * side * side).view(3, side, side)
    # PixelUnshuffle of this picture counts 0, 1, 2, ... through its channels.
    return gather(picture.permute(1, 2, 0)).reshape(-1)


class _Conv:
    """A convolution with its weights cast, laid out and ordered once.

    Args:
        conv: The trained layer.
        dtype: To compute in; int8 takes and gives float32.
        inputs: Order of the input channels, None as trained.
        outputs: Order of the output channels.
        scale: Factor on the weights, not on the bias.
    """

    def __init__(
        self,
        conv: nn.Conv2d,
        dtype: torch.dtype,
        inputs: Tensor | None = None,
        outputs: Tensor | None = None,
        scale: float = 1.0,
    ) -> None:
        weight, bias = conv.weight.detach().float() * scale, conv.bias
        if inputs is not None:
            weight = weight[:, inputs.to(weight.device)]
        if outputs is not None:
            weight = weight[outputs.to(weight.device)]
            bias = None if bias is None else bias[outputs.to(weight.device)]
        self.num_inputs = conv.in_channels
        self._convolve = _convolution(weight, None if bias is None else bias.detach(), conv, dtype)

    def __call__(self, x: Tensor) -> Tensor:
        """Convolve ``(1, C, h, w)``."""
        return self._convolve(x)


def _convolution(
    weight: Tensor, bias: Tensor | None, like: nn.Conv2d, dtype: torch.dtype
) -> Callable[[Tensor], Tensor]:
    stride, padding = like.stride, like.padding
    assert not isinstance(padding, str)
    if dtype == torch.int8:
        return Int8Conv(weight, bias, stride, padding)
    cast = weight.to(dtype).contiguous(memory_format=torch.channels_last)
    shift = None if bias is None else bias.to(dtype)
    return lambda x: torch.conv2d(x, cast, shift, stride, padding)


def _of_values(dtype: torch.dtype) -> torch.dtype:
    """Return the type between convolutions, and of those that are never of integers."""
    return torch.float32 if dtype == torch.int8 else dtype


class _Stage:
    """Channel attention and residual units, in place where the input is not needed again."""

    def __init__(self, stage: Stage, dtype: torch.dtype) -> None:
        self._attention: ChannelAttention = stage.attention
        self._units = [(_Conv(u.conv1, dtype), _Conv(u.conv2, dtype)) for u in stage.units]  # type: ignore[arg-type]

    def __call__(self, x: Tensor, condition: Tensor) -> Tensor:
        """Refine ``(1, C, h, w)``, which is overwritten."""
        flat = _rows(x).reshape(-1, x.shape[1])  # (h w, C)
        pooled = flat.new_ones(1, flat.shape[0]) @ flat  # one pass that sums in float32
        pooled = torch.cat((pooled.float() / flat.shape[0], condition), dim=1)
        hidden = torch.relu(self._attention.squeeze(pooled))
        gate = 2.0 * torch.sigmoid(self._attention.excite(hidden))
        x = x.mul_(gate.to(x.dtype)[:, :, None, None])
        for conv1, conv2 in self._units:
            x = conv2(leaky_relu(conv1(x), HIDDEN_SLOPE, inplace=True)).add_(x)
        return x


class _Upsample:
    """1x1 convolution whose output channels are in the order in which spreading copies long runs."""

    def __init__(self, conv: nn.Conv2d, dtype: torch.dtype) -> None:
        channels = conv.out_channels // 4
        order = torch.arange(4 * channels).view(channels, 4).t().reshape(-1)
        self._conv = _Conv(conv, dtype, outputs=order)

    def __call__(self, x: Tensor) -> Tensor:
        """Map ``(1, C, h, w)`` to ``(1, C', 2h, 2w)``."""
        return _image(_spread(_rows(self._conv(x)), 2))


class _ArrangedEncoder:
    """``Encoder`` for one frame."""

    def __init__(self, encoder: Encoder, dtype: torch.dtype) -> None:
        self._dtype = exact = _of_values(dtype)
        # Pixels enter as value - 127.5, which bfloat16 holds exactly; 1/255 is in the weights.
        scale = 1.0 / 255.0
        self._stem = _Conv(encoder.stem, dtype, inputs=_fold_order(), scale=scale)
        self._down8, self._down16 = _Conv(encoder.down8, dtype), _Conv(encoder.down16, dtype)
        self._stages = [_Stage(s, dtype) for s in (encoder.stage4, encoder.stage8, encoder.stage16)]
        self._head = _Conv(encoder.head, exact)
        self._transform = _Conv(encoder.linear.transform, exact, inputs=_block_order(), scale=scale)
        self._mix = _Conv(encoder.linear.mix, exact)
        self._share = None if encoder.share is None else _Conv(encoder.share, exact)

    def __call__(self, pixels: Tensor, snr_db: Tensor, share: Tensor | None) -> Tensor:
        """Encode ``(H, W, 3)`` uint8 to the float latent ``(1, C, H/16, W/16)``."""
        condition = condition_vector(snr_db)
        folded = _gather(pixels, _FOLD).to(self._dtype).sub_(127.5)  # (H/4, W/4, 48)
        f = self._stages[0](self._stem(_image(folded)).relu_(), condition)
        f = self._stages[1](self._down8(f).relu_(), condition)
        f = self._down16(f)
        if self._share is not None and share is not None:
            f += self._share(share.to(self._dtype))
        f = self._stages[2](f.relu_(), condition)
        added, log_gain = self._head(f.relu_()).float().chunk(2, dim=1)
        gain = torch.exp(log_gain.clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN))
        coefficients = self._transform(_image(_gather(folded, _GROUPS))) * gain
        return self._mix(coefficients.to(self._dtype)).float() + added


class _ArrangedDecoder:
    """``Decoder`` and ``ConfidenceBranch`` for one frame."""

    def __init__(self, decoder: Decoder, branch: ConfidenceBranch, dtype: torch.dtype) -> None:
        self._dtype = exact = _of_values(dtype)
        order = _fold_order()
        self._linear: BlockSynthesis = decoder.linear
        self._unmix = _Conv(decoder.linear.unmix, exact)
        self._transform = _Conv(decoder.linear.transform, exact, outputs=_block_order())
        self._stem = _Conv(decoder.stem, dtype)
        self._adapt = _Conv(decoder.adapt_head, exact)
        self._stages = [_Stage(s, dtype) for s in (decoder.stage16, decoder.stage8, decoder.stage4)]
        self._up8, self._up4 = _Upsample(decoder.up8.conv, dtype), _Upsample(decoder.up4.conv, dtype)
        self._estimate = _Conv(decoder.estimate, dtype, inputs=order)
        self._head = _Conv(decoder.head, exact, outputs=order)
        self._start = _Conv(branch.start, dtype)
        self._fuse16, self._fuse8 = _Conv(branch.fuse16, dtype), _Conv(branch.fuse8, dtype)
        before = torch.arange(branch.fuse4.in_channels - order.numel())
        self._fuse4 = _Conv(branch.fuse4, dtype, inputs=torch.cat((before, before.numel() + order)))
        self._up8c, self._up4c = _Upsample(branch.up8.conv, dtype), _Upsample(branch.up4.conv, dtype)
        self._maps = _Conv(branch.head, dtype)

    def _linear_estimate(self, y: Tensor, shrink: Tensor, scale: Tensor, adapt: Tensor) -> Tensor:
        """Estimate as ``BlockSynthesis`` does, folded: ``(1, 48, 4 h, 4 w)``."""
        gain = self._linear.gain(shrink, scale, adapt)
        coefficients = self._unmix(y.to(self._dtype)).float() * gain
        return _image(_spread(_rows(self._transform(coefficients.to(self._dtype))), _GROUPS))

    def __call__(
        self, y_rx: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See ``InferenceNet.decode``."""
        share: tuple[Tensor, ...] = ()
        if values is None:
            y, snr_db, scale = demodulate(y_rx, snr_db, is_qam)
            shrink = shrink_of(snr_db)
        else:
            share = (share_plane(values),)
            sent = sent_mask(values, self._unmix.num_inputs)
            y = unpack(analog_values(y_rx, snr_db, is_qam), sent)
            of_slots = shrink_of(effective_snr_db(snr_db, is_qam)).expand_as(y_rx)
            y, snr_db, shrink, scale = blocks_arrived(y, unpack(of_slots, sent), sent)
        condition = condition_vector(snr_db.mean(dim=(1, 2, 3)))
        planes = (y, normalise_snr_db(snr_db), shrink, *share)
        received = torch.cat(planes, dim=1).to(self._dtype).contiguous(memory_format=torch.channels_last)
        at16 = self._stages[0](self._stem(received).relu_(), condition)
        opened = at16.relu()
        folded = self._linear_estimate(y, shrink, scale, self._adapt(opened))
        at8 = self._stages[1](self._up8(opened).relu_(), condition)
        at4 = self._up4(at8.relu()).add_(self._estimate(folded)).relu_()
        at4 = self._stages[2](at4, condition)
        x_folded = self._head(at4.relu()).float().add_(folded)  # (1, 48, 4 h, 4 w), around 0
        confidence, displacement = self._judge(received, at16, at8, at4, x_folded)
        # + 128: 127.5 undoes the centring, 0.5 makes the truncation of the cast a rounding.
        pixels = x_folded.mul_(255.0).add_(128.0).clamp_(0.0, 255.5).to(torch.uint8)
        return _spread(_rows(pixels), _FOLD), confidence, displacement

    def _judge(
        self, received: Tensor, at16: Tensor, at8: Tensor, at4: Tensor, x_folded: Tensor
    ) -> tuple[Tensor, Tensor]:
        f = self._start(received).relu_()
        f = self._up8c(self._fuse16(torch.cat((f, at16), dim=1)).relu_())
        f = self._up4c(self._fuse8(torch.cat((f, at8), dim=1)).relu_())
        f = self._fuse4(torch.cat((f, at4, x_folded.to(self._dtype)), dim=1)).relu_()
        maps = self._maps(f)[0].float().contiguous()  # (32, 4 h, 4 w), channel 16 m + 4 i + j
        confidence = _unfold(torch.sigmoid(maps[:16]))
        return confidence, _unfold(logsigmoid(-maps[16:]).neg_())  # softplus, vectorised


def _unfold(planes: Tensor) -> Tensor:
    """Shuffle ``(16, h, w)`` into ``(4 h, 4 w)``."""
    _, height, width = planes.shape
    grid = planes.view(_FOLD, _FOLD, height, width).permute(2, 0, 3, 1)
    return grid.reshape(height * _FOLD, width * _FOLD)


class ArrangedNet:
    """3DC-SC of any size; equals its modules up to rounding."""

    def __init__(self, model: Transceiver, dtype: torch.dtype) -> None:
        assert isinstance(model.encoder, Encoder)
        assert isinstance(model.decoder, Decoder)
        assert isinstance(model.confidence, ConfidenceBranch)
        self._encoder = _ArrangedEncoder(model.encoder, dtype)
        self._decoder = _ArrangedDecoder(model.decoder, model.confidence, dtype)

    def latent(self, pixels: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None) -> Tensor:
        """See ``InferenceNet``."""
        share = None if values is None else share_plane(values)
        return self._encoder(pixels, effective_snr_db(snr_db, is_qam), share)

    def decode(
        self, y_rx: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See ``InferenceNet``."""
        return self._decoder(y_rx, snr_db, is_qam, values)
