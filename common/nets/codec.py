"""A trained transceiver behind the codec interface: numpy in, numpy out, on CPU or GPU."""

from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from semcast.common.codec import (
    DEFAULT_CODEC,
    LOST_SLOT_SNR_DB,
    DecodedImage,
    Device,
    EncodedImage,
    Modulation,
    Precision,
    ReceivedImage,
    check_fixed_rate,
    check_modulation,
    confidence_from_displacement_px,
)
from semcast.common.errors import CheckpointError, ConfigError
from semcast.common.nets.checkpoint import load_transceiver
from semcast.common.nets.coder_input import coder_input
from semcast.common.nets.detail import allocation_for
from semcast.common.nets.inference import can_arrange, inference_net
from semcast.common.nets.latent import latent_from_symbols, symbols_from_latent
from semcast.common.nets.manifest import Manifest, weights_path
from semcast.common.nets.precision import dtype_for
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.allocation import Allocation
from semcast.common.phy.slots import layout_for
from semcast.common.shapes import check_shape

#: No honest equaliser gives larger values; anything above is damage.
_MAX_SYMBOL = 16.0


def check_device(device: Device) -> None:
    """Make sure that a device which is asked for is there.

    Raises:
        ConfigError: There is no such device, or no device of that name.
    """
    if device not in get_args(Device):
        raise ConfigError(f"device must be one of {', '.join(get_args(Device))}, got {device!r}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device must be auto or cpu on this machine, which has no usable GPU, got 'cuda'")


def torch_device(device: Device) -> torch.device:
    """Return the device that is asked for; ``auto`` takes a GPU where there is one.

    Raises:
        ConfigError: See ``check_device``.
    """
    check_device(device)
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")


class NeuralCodec:
    """Encoder and decoder of one learned transceiver.

    Images are padded to whole 16x16 blocks by repeating the border and cropped back. The same input gives the
    same bits out on the same machine with the same number of threads.

    Args:
        model: A trained transceiver.
        manifest: Of its weights.
        modulation: How symbols travel.
        device: Where to compute.
        precision: What convolutions are computed in; see ``dtype_for``.

    Attributes:
        precision: That which was chosen, not ``auto``.

    Raises:
        ConfigError: There is no such modulation, or the network can't be computed in that precision here.
    """

    def __init__(
        self,
        model: Transceiver,
        manifest: Manifest,
        modulation: Modulation,
        device: torch.device,
        precision: Precision = "auto",
    ) -> None:
        check_modulation(modulation)
        self.manifest = manifest
        self.modulation: Modulation = modulation
        self._device = device
        dtype = dtype_for(precision, device, can_arrange(model))
        self.precision = str(dtype).removeprefix("torch.")
        model = model.to(device).eval().requires_grad_(False)
        self._model = model
        self._net = inference_net(model, dtype)
        self._is_qam = (
            torch.ones(1, device=device) if modulation == "16qam" else torch.zeros(1, device=device)
        )

    @classmethod
    def load(
        cls,
        name_or_path: str | Path = DEFAULT_CODEC,
        modulation: Modulation = "16qam",
        num_threads: int | None = None,
        device: Device = "auto",
        precision: Precision = "auto",
    ) -> "NeuralCodec":
        """Load shipped weights by name, or any weights file with its manifest beside it.

        Args:
            name_or_path: Such as ``3dcsc-lite`` or ``checkpoints/3dcsc-lite/3dcsc-lite.safetensors``.
            modulation: How symbols travel.
            num_threads: Threads of torch in this process; None leaves them as they are.
            device: ``auto`` takes a GPU where there is one.
            precision: What convolutions are computed in; see ``dtype_for``.

        Raises:
            CheckpointError: There are no such weights, they do not fit their manifest, or are not for the
                modulation.
            ConfigError: There is no such device, or the network can't be computed in that precision there.
            ValueError: The number of threads is not usable.
        """
        if num_threads is not None:
            if num_threads < 1:
                raise ValueError(f"num_threads must be >= 1, got {num_threads}")
            torch.set_num_threads(num_threads)
        where = torch_device(device)
        model, manifest = load_transceiver(weights_path(name_or_path))
        if modulation not in manifest.modulations:
            ways = ", ".join(map(str, manifest.modulations))
            raise CheckpointError(f"weights {name_or_path} are for the modulation {ways}, got {modulation!r}")
        return cls(model, manifest, modulation, where, precision)

    @property
    def name(self) -> str:
        """Registry name of the architecture."""
        return self.manifest.architecture

    @property
    def digest(self) -> str:
        """First 16 hex digits of the sha256 of the weights."""
        return self.manifest.sha256[:16]

    def encode(self, image: NDArray[np.uint8], snr_db: float) -> EncodedImage:
        """Encode one image for a link whose expected SNR is ``snr_db``.

        An image that uses less than half of the grey levels is stretched to all of them first.

        Args:
            image: ``(H, W, 3)`` uint8 RGB.
            snr_db: Expected SNR in dB; values outside the trained range are clipped to it.

        Raises:
            ValueError: The image is not of that shape and type, or has no pixel.
        """
        given = coder_input(image, snr_db, self.manifest.snr_range_db)
        allocation = allocation_for(given.image) if self._model.is_variable else None
        with torch.inference_mode():
            pixels = torch.from_numpy(given.image).to(self._device)
            snr = torch.full((1,), given.snr_db, device=self._device)
            values = None if allocation is None else self._plane(allocation.values)
            latent = self._net.latent(pixels, snr, self._is_qam, values)
            symbols = self._model.transmit(latent, self._is_qam, values)[0]
        return EncodedImage(
            shape_hw=given.shape_hw,
            symbols=symbols_from_latent(symbols.cpu().numpy()),
            modulation=self.modulation,
            levels=given.levels,
            allocation=b"" if allocation is None else allocation.code,
        )

    def _allocation_of(self, received: ReceivedImage) -> Allocation | None:
        """Return what each block sent, None at a fixed rate."""
        if not self._model.is_variable:
            check_fixed_rate(received)
            return None
        layout = layout_for(received.shape_hw)
        grid = (layout.num_slots, layout.blocks_per_slot)
        if not received.allocation and (received.effective_snr_db <= LOST_SLOT_SNR_DB).all():
            return Allocation.fixed(grid)  # of a frame of which nothing arrived
        return Allocation.from_code(received.allocation, grid)

    def _plane(self, of_blocks: NDArray[np.generic]) -> torch.Tensor:
        return torch.from_numpy(of_blocks)[None, None].to(self._device)

    def decode(self, received: ReceivedImage) -> DecodedImage:
        """Decode one frame with its two confidence maps.

        A slot with a value that is not finite counts as lost. Where everything is lost the image is the
        network's guess of nothing and ``outage`` is set.

        Args:
            received: Equalised symbols; their number must fit the image's shape.

        Raises:
            ValueError: Sizes contradict each other, the modulation is not this codec's, or the allocation is
                none of this frame.
        """
        layout = layout_for(received.shape_hw)
        check_shape(received.symbols, f"{layout.num_slots} {layout.data_per_slot}", "symbols")
        check_shape(received.effective_snr_db, f"{layout.num_slots}", "effective_snr_db")
        if received.modulation != self.modulation:
            raise ValueError(f"modulation must be {self.modulation!r}, got {received.modulation!r}")
        snr_db = np.nan_to_num(
            received.effective_snr_db.astype(np.float32),
            nan=LOST_SLOT_SNR_DB,
            posinf=30.0,
            neginf=LOST_SLOT_SNR_DB,
        ).clip(LOST_SLOT_SNR_DB, 30.0)
        arrived = np.asarray(np.isfinite(received.symbols).all(axis=1))
        snr_db[~arrived] = LOST_SLOT_SNR_DB
        latent = latent_from_symbols(np.where(arrived[:, None], received.symbols, np.complex64(0.0)))
        latent = latent.clip(-_MAX_SYMBOL, _MAX_SYMBOL)
        height, width = received.shape_hw
        allocation = self._allocation_of(received)
        with torch.inference_mode():
            y_rx = torch.from_numpy(latent)[None].to(self._device, memory_format=torch.channels_last)
            plane = torch.from_numpy(snr_db).to(self._device).view(1, 1, -1, 1)
            plane = plane.expand(1, 1, -1, layout.blocks_per_slot)
            values = None if allocation is None else self._plane(allocation.values)
            maps = self._net.decode(y_rx, plane, self._is_qam, values)
            image, confidence, moved_px = (m[:height, :width].contiguous().cpu().numpy() for m in maps)
        return DecodedImage(
            image=received.levels.unstretch(image),
            confidence=confidence,
            keypoint_confidence=confidence_from_displacement_px(moved_px),
            outage=bool((snr_db <= LOST_SLOT_SNR_DB).all()),
        )
