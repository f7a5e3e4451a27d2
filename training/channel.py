"""The differentiable radio link of training: fading and lost slots, noise, MMSE equaliser, estimated SNR.

It follows the definitions of the real link: ``noise_var = 10 ** (-snr_db / 10)`` for each complex symbol,
half for each real, one fading coefficient for each slot, whose phase the equaliser removes.
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from semcast.common.codec import LOST_SLOT_SNR_DB
from semcast.common.nets.modulation import effective_snr_db

#: Networks are told no more than this.
_MAX_SNR_DB = 30.0


@dataclass(frozen=True, kw_only=True)
class LinkDrawSettings:
    """What the links of a batch look like.

    Attributes:
        snr_min_db: Lowest average SNR drawn.
        snr_max_db: Highest average SNR drawn.
        share_16qam: Share of images sent with 16-QAM; the others are analog.
        share_faded: Share of images whose slots fade (Rayleigh or Rician).
        share_lossy: Share of images of which slots are lost.
        lost_max: Largest share of lost slots in such an image.
        feedback_sd_db: Error of the SNR the transmitter believes in.
        estimate_sd_db: Error of the SNR the receiver estimates for each slot.
    """

    snr_min_db: float = field(default=0.0, metadata={"help": "lowest SNR in dB"})
    snr_max_db: float = field(default=14.0, metadata={"help": "highest SNR in dB"})
    share_16qam: float = field(
        default=0.75, metadata={"help": "share of images sent with 16-QAM; the others are analog"}
    )
    share_faded: float = field(default=0.15, metadata={"help": "share of images whose slots fade"})
    share_lossy: float = field(default=0.15, metadata={"help": "share of images that lose slots"})
    lost_max: float = field(default=0.5, metadata={"help": "largest share of lost slots in such an image"})
    feedback_sd_db: float = field(
        default=1.0, metadata={"help": "error of the SNR the transmitter believes in, in dB"}
    )
    estimate_sd_db: float = field(
        default=0.5, metadata={"help": "error of the SNR the receiver estimates, in dB"}
    )

    def __post_init__(self) -> None:
        for name in ("snr_min_db", "snr_max_db"):
            value = getattr(self, name)
            if not LOST_SLOT_SNR_DB <= value <= _MAX_SNR_DB:
                raise ValueError(f"{name} must be in [{LOST_SLOT_SNR_DB:g}, {_MAX_SNR_DB:g}], got {value:g}")
        if self.snr_min_db > self.snr_max_db:
            raise ValueError(f"snr_min_db must be <= snr_max_db ({self.snr_max_db}), got {self.snr_min_db}")
        for name in ("share_16qam", "share_faded", "share_lossy", "lost_max"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {value}")
        for name in ("feedback_sd_db", "estimate_sd_db"):
            value = getattr(self, name)
            if not 0.0 <= value <= _MAX_SNR_DB:
                raise ValueError(f"{name} must be in [0, {_MAX_SNR_DB:g}], got {value:g}")


@dataclass(frozen=True)
class LinkDraw:
    """The links of one batch.

    Attributes:
        snr_db: ``(B,)`` true average SNR.
        expected_snr_db: ``(B,)`` what the transmitter believes.
        is_qam: ``(B,)`` 1 for 16-QAM.
        gain: ``(B, 1, h, 1)`` power gain ``|h|^2`` of each slot, 0 where it is lost; or ``(B, C, h, w)`` of
            each value.
        estimate_error_db: Of the same shape.
    """

    snr_db: Tensor
    expected_snr_db: Tensor
    is_qam: Tensor
    gain: Tensor
    estimate_error_db: Tensor

    def to(self, device: torch.device) -> "LinkDraw":
        """Return the draw on a device."""
        return LinkDraw(*(to_device(t, device) for t in vars(self).values()))

    def pin_memory(self) -> "LinkDraw":
        """Return the draw in memory from which a GPU fetches it on its own."""
        return LinkDraw(*(t.pin_memory() for t in vars(self).values()))

    def as_analog(self) -> "LinkDraw":
        """Return links over which analog values arrive as well as over these those that they carry."""
        slot_db = self.snr_db.view(-1, 1, 1, 1) + 10.0 * torch.log10(self.gain.clamp_min(1e-6))
        arriving_db = effective_snr_db(slot_db, self.is_qam)
        believed_db = effective_snr_db(slot_db + self.estimate_error_db, self.is_qam)
        return LinkDraw(
            torch.zeros_like(self.snr_db),
            effective_snr_db(self.expected_snr_db, self.is_qam),
            torch.zeros_like(self.is_qam),
            torch.where(self.gain == 0.0, 0.0, 10.0 ** (arriving_db / 10.0)),
            believed_db - arriving_db,
        )

    def per_value(self, in_next_slot: Tensor) -> "LinkDraw":
        """Return the links of values some of which are in the slot below that of their row.

        Args:
            in_next_slot: ``(B, C, h, w)`` bool.
        """
        gain, error_db = (
            torch.where(in_next_slot, slots.roll(-1, dims=2), slots)
            for slots in (self.gain, self.estimate_error_db)
        )
        return replace(self, gain=gain, estimate_error_db=error_db)


def to_device(values: Tensor, device: torch.device) -> Tensor:
    """Bring values from the CPU to a device without waiting for what the device does."""
    if device.type == "cuda" and not values.is_pinned():
        values = values.pin_memory()
    return values.to(device, non_blocking=True)


def draw_links(
    settings: LinkDrawSettings, batch: int, num_slots: int, generator: torch.Generator
) -> LinkDraw:
    """Draw the links of a batch on the CPU."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    snr_db = settings.snr_min_db + (settings.snr_max_db - settings.snr_min_db) * uniform(batch)
    expected = snr_db + settings.feedback_sd_db * normal(batch)
    is_qam = (uniform(batch) < settings.share_16qam).float()
    rician_k = torch.where(uniform(batch, 1) < 0.5, torch.zeros(batch, 1), 6.0 * uniform(batch, 1))
    line_of_sight = (rician_k / (1.0 + rician_k)).sqrt()
    scatter = (0.5 / (1.0 + rician_k)).sqrt()
    fading = (line_of_sight + scatter * normal(batch, num_slots)).square()
    fading = fading + (scatter * normal(batch, num_slots)).square()
    faded = uniform(batch, 1) < settings.share_faded
    gain = torch.where(faded, fading, torch.ones_like(fading))
    lossy = uniform(batch, 1) < settings.share_lossy
    lost = uniform(batch, num_slots) < settings.lost_max * uniform(batch, 1)
    gain = torch.where(lossy & lost, torch.zeros_like(gain), gain)
    error = settings.estimate_sd_db * normal(batch, num_slots)
    return LinkDraw(snr_db, expected, is_qam, gain[:, None, :, None], error[:, None, :, None])


def through_link(y: Tensor, draw: LinkDraw, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Send real symbol parts through the links and equalise them.

    Args:
        y: ``(B, C, h, w)`` real and imaginary parts, power 1/2 each.
        draw: The links, on the device of ``y``.
        noise: Standard normal values of the shape of ``y``.

    Returns:
        The MMSE estimate ``(B, C, h, w)`` and the effective SNR as the receiver knows it, in dB: ``(B, 1, h,
        w)``, or ``(B, C, h, w)`` where gains are those of values.
    """
    noise_var = 10.0 ** (-draw.snr_db / 10.0).view(-1, 1, 1, 1)
    lost = draw.gain == 0.0
    effective_db = 10.0 * torch.log10(draw.gain.clamp_min(1e-6) / noise_var) + draw.estimate_error_db
    effective_db = torch.where(lost, torch.full_like(effective_db, LOST_SLOT_SNR_DB), effective_db)
    effective_db = effective_db.clamp_min(LOST_SLOT_SNR_DB)
    linear = 10.0 ** (effective_db / 10.0)
    unbiased = y + noise * (0.5 * noise_var / draw.gain.clamp_min(1e-6)).sqrt()
    y_rx = torch.where(lost, torch.zeros_like(y), unbiased * linear / (1.0 + linear))
    return y_rx, effective_db.expand(-1, -1, -1, y.shape[-1])
