"""One training run: model, average and optimisers, a step of theirs, and the checkpoint it goes on from."""

import copy
import io
import json
import os
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray

from semcast.common.errors import CheckpointError, ConfigError, SourceError
from semcast.common.nets.checkpoint import load_transceiver, save_transceiver
from semcast.common.nets.codec import check_device
from semcast.common.nets.precision import has_fast_bfloat16
from semcast.common.nets.registry import architecture
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.slots import BLOCK_PX, channel_bandwidth_ratio
from semcast.common.source_commit import source_commit
from semcast.common.whole_file import check_writable, write_whole
from semcast.training.centring import centre_hidden, folded, unfolded
from semcast.training.channel import to_device
from semcast.training.data import Ahead, Crops, read_images
from semcast.training.divergence import Divergence
from semcast.training.draws import Draws, seed_of_step
from semcast.training.growing import grow
from semcast.training.klt import start_from_klt
from semcast.training.losses import through_whole_link, transceiver_loss
from semcast.training.masked import masked_image_loss
from semcast.training.optimisers import build_optimisers, rate_factor, set_rate
from semcast.training.settings import TrainSettings
from semcast.training.varying import Observations, vary

_VALID_IMAGES = 16
#: Raised when the same weights mean another network.
CHECKPOINT_FORMAT = 3
#: What torch raises on files that are no checkpoints: it takes some for pickles and does as they say.
_DAMAGED = (RuntimeError, ValueError, EOFError, LookupError, TypeError, pickle.UnpicklingError)
#: Batches the means of hidden units are taken from, crops in each, and a step no run gets to.
_FOLD_BATCHES, _FOLD_CROPS, _FOLD_STEP = 24, 16, 2**40


class Run:
    """State of one run: model, average, optimisers, step."""

    def __init__(self, settings: TrainSettings, rank: int, world: int) -> None:
        self.settings, self.rank, self.world = settings, rank, world
        check_device(settings.device)
        if rank == 0:
            check_writable(self.checkpoint_path, "out")  # not after the first thousand steps
        if settings.grow_from is not None and not settings.grow_from.is_file():
            raise ConfigError(f"grow_from must be a file of weights, got {settings.grow_from}: no such file")
        use_cuda = settings.device == "cuda" or (settings.device == "auto" and torch.cuda.is_available())
        local = int(os.environ.get("LOCAL_RANK", "0"))
        self.device = torch.device("cuda", local) if use_cuda else torch.device("cpu")
        self.bf16 = settings.bf16 and (use_cuda or has_fast_bfloat16())
        torch.backends.cudnn.benchmark = True  # crops keep their size
        entry = architecture(settings.architecture)
        torch.manual_seed(settings.seed)  # layers draw their first weights from the global generator
        model: Transceiver = entry.build(entry.sizes)
        self._is_variable = model.is_variable
        self.images = _images_of(settings.data, "--data")
        valid = settings.valid
        self.valid_images = _images_of(valid, "--valid")[:_VALID_IMAGES] if valid else []
        self.step, self.elapsed_s = 0, 0.0
        self.saved_step: int | None = None
        self.divergence = Divergence()
        self.agreed_s = 0.0  # elapsed time all processes agree on, since the schedule depends on it
        self._is_asked_to_stop = self.agreed_stop = False
        self.snr_range_db = (settings.channel.snr_min_db, settings.channel.snr_max_db)
        checkpoint = self._read_checkpoint()
        if checkpoint is None and settings.grow_from is not None:
            small, manifest = load_transceiver(settings.grow_from)
            if settings.only_heads:  # in others the encoder would be told other SNRs
                self.snr_range_db = manifest.snr_range_db
            small = small if settings.only_heads else unfolded(small, self._pass_images)
            if model.is_variable and not small.is_variable:
                seen = Observations()
                with torch.no_grad():
                    self._pass_images(small, seen.add)
                vary(small, model, seen)
            else:
                grow(small, model)
        elif checkpoint is None and settings.start == "klt":
            start_from_klt(model, self.images, torch.Generator().manual_seed(settings.seed))
        self.model = model.to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if settings.only_heads:
            self.model.eval()
            self.model.encoder.requires_grad_(False)
            self.model.decoder.requires_grad_(False)
        else:
            centre_hidden(self.model)
        self.average = copy.deepcopy(self.model).eval()
        # Walking through the modules for them in every step takes a GPU's time.
        self.weights, self.averages = list(self.model.parameters()), list(self.average.parameters())
        if settings.compile:
            self.model.encoder.compile(dynamic=False)
            self.model.decoder.compile(dynamic=False)
        self.optimisers = build_optimisers(self.model, settings)
        if checkpoint is not None:
            self._restore(checkpoint)
        self.ahead = Ahead(self._draws(settings.batch, rank), settings.data_workers, pinned=use_cuda)

    @property
    def checkpoint_path(self) -> Path:
        """Where everything needed to go on is kept."""
        return self.settings.out / "last.pt"

    def _read_checkpoint(self) -> dict[str, Any] | None:
        if not self.settings.resume or not self.checkpoint_path.is_file():
            return None
        try:
            state = torch.load(self.checkpoint_path, map_location="cpu", weights_only=True)
            if not isinstance(state, dict):
                raise TypeError
        except (OSError, *_DAMAGED) as err:
            raise CheckpointError(
                f"checkpoint {self.checkpoint_path} can't be read: {type(err).__name__}"
            ) from err
        if state.get("format") != CHECKPOINT_FORMAT:
            raise CheckpointError(
                f"checkpoint {self.checkpoint_path} must have format {CHECKPOINT_FORMAT}, got "
                f"{state.get('format')}: the network has changed since"
            )
        if state["architecture"] != self.settings.architecture:
            raise CheckpointError(
                f"checkpoint {self.checkpoint_path} is of {state['architecture']}, "
                f"not {self.settings.architecture}"
            )
        return state

    def _restore(self, state: dict[str, Any]) -> None:
        try:
            self.model.load_state_dict(state["model"])
            self.average.load_state_dict(state["average"])
        except RuntimeError as err:
            raise CheckpointError(f"checkpoint {self.checkpoint_path} does not fit: {err}") from err
        # Moments are the checkpoint's; rates and weight decay are those asked for now.
        fresh = [
            [{name: v for name, v in group.items() if name != "params"} for group in o.param_groups]
            for o in self.optimisers
        ]
        try:
            for optimiser, saved in zip(self.optimisers, state["optimisers"], strict=True):
                optimiser.load_state_dict(saved)
        except ValueError as err:
            raise CheckpointError(
                f"checkpoint {self.checkpoint_path} was made with another optimiser or only_heads: give the "
                "same, another out, or resume = false"
            ) from err
        for optimiser, groups in zip(self.optimisers, fresh, strict=True):
            for group, values in zip(optimiser.param_groups, groups, strict=True):
                group.update(values)
        self.step, self.elapsed_s = state["step"], state["elapsed_s"]
        self.saved_step = self.step
        if self.settings.only_heads:
            self.snr_range_db = state.get("snr_range_db", self.snr_range_db)  # not in those of older code
        self.agreed_s = self.elapsed_s

    def breakdown(self) -> str | None:
        """Return what has gone wrong with weights or losses, None while the run can go on."""
        return self.divergence.found_in(self.weights + self.averages)

    def save(self) -> None:
        """Write the checkpoint; a crash while writing leaves the old one, and so does a breakdown."""
        if self.rank or self.breakdown() is not None:
            return
        self.settings.out.mkdir(parents=True, exist_ok=True)
        state = {
            "format": CHECKPOINT_FORMAT,
            "architecture": self.settings.architecture,
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "optimisers": [o.state_dict() for o in self.optimisers],
            "step": self.step,
            "elapsed_s": self.elapsed_s,
            "snr_range_db": self.snr_range_db,
        }
        packed = io.BytesIO()  # torch gives an error of its own where a disk is full
        torch.save(state, packed)
        write_whole(self.checkpoint_path, packed.getvalue())
        self.saved_step = self.step

    def shippable(self) -> Transceiver:
        """Return the averaged weights as they run without the aids of training."""
        average: Transceiver = self.average
        return average if self.settings.only_heads else folded(average, self._pass_images)

    def _draws(self, batch: int, rank: int) -> Draws:
        settings = self.settings
        crops = Crops(self.images, settings.crop, batch, settings.seed, rank)
        allocation = settings.allocation if self._is_variable else None
        return Draws(crops, settings.channel, allocation, settings.seed, rank)

    def _pass_images(
        self,
        model: Transceiver,
        see: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], None] | None = None,
    ) -> None:
        """Run fresh crops, the same ones in every process, through the whole link.

        Args:
            model: The transceiver.
            see: Called with the images, the latent and the decoded images of every batch.
        """
        settings = self.settings
        draws = self._draws(_FOLD_CROPS, rank=0)
        device = next(model.parameters()).device
        blocks = settings.crop.size_px // BLOCK_PX
        generator = torch.Generator().manual_seed(settings.seed)
        for k in range(_FOLD_BATCHES):
            drawn = draws[_FOLD_STEP + k]
            x = drawn.pixels.to(device).float() / 255.0
            draw = drawn.links.to(device)
            noise = torch.randn((len(x), model.channels, blocks, blocks), generator=generator).to(device)
            sent = drawn.sent.to(device) if drawn.sent is not None and model.is_variable else None
            with torch.autocast(device.type, torch.bfloat16, enabled=self.bf16):
                _, x_hat, _ = through_whole_link(model, x, draw, noise, sent)
                if see is not None:
                    values = None if sent is None else sent.values
                    see(x, model.latent(x, draw.expected_snr_db, draw.is_qam, values), x_hat)

    def export(self, model: Transceiver, valid: dict[str, float]) -> Path:
        """Write the averaged weights, as ``shippable`` gives them, in half precision with their manifest."""
        settings = self.settings
        weights = settings.out / f"{settings.architecture}.safetensors"
        plain = json.loads(json.dumps(asdict(settings), default=str))
        for folder in ("data", "valid", "out"):
            plain.pop(folder)
        plain["bf16"] = self.bf16
        if settings.grow_from is not None:
            plain["grow_from"] = settings.grow_from.name
        save_transceiver(
            model,
            weights,
            architecture=settings.architecture,
            sizes=architecture(settings.architecture).sizes,
            cbr=channel_bandwidth_ratio((BLOCK_PX, BLOCK_PX)),
            snr_range_db=self.snr_range_db,
            made_by={
                "settings": plain,
                "images": len(self.images),
                "steps": self.step,
                "samples": self.step * settings.batch * self.world,
                "wall_time_s": round(self.elapsed_s),
                "processes": self.world,
                "device": self.device.type,
                "seed": settings.seed,
                "commit": source_commit(),
                "torch": torch.__version__,
            },
            measured={"validation": valid} if valid else {},
        )
        return weights

    def share_done(self) -> float:
        """Return the share of the run that is done, by steps or by time, whichever is further."""
        share = self.step / self.settings.steps
        if self.settings.minutes > 0.0:
            share = max(share, self.agreed_s / (60.0 * self.settings.minutes))
        return min(1.0, share)

    def one_step(self) -> dict[str, torch.Tensor]:
        """Draw a batch and its links, and update the weights once."""
        settings, share = self.settings, self.share_done()
        drawn = self.ahead.get(self.step)
        x = to_device(drawn.pixels, self.device).float() / 255.0
        x = x.contiguous(memory_format=torch.channels_last)
        seed = seed_of_step(settings.seed, self.rank, self.step)
        blocks = settings.crop.size_px // BLOCK_PX
        draw = drawn.links.to(self.device)
        if share < settings.analog_share:
            draw = replace(draw, is_qam=torch.zeros_like(draw.is_qam))
        # Drawn where it is used: on a CPU the noise of a large batch would cost a GPU more than the network.
        on_device = torch.Generator(self.device).manual_seed(seed + 1_000_003)
        shape = (settings.batch, self.model.channels, blocks, blocks)
        noise = torch.randn(shape, generator=on_device, device=self.device)
        sent = None if drawn.sent is None else drawn.sent.to(self.device)
        is_ending = share >= 1.0 - settings.decay_share / 4.0
        with_heads = settings.only_heads or is_ending or self.step % settings.head_every == 0
        set_rate(self.optimisers, rate_factor(share, self.step, settings))
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            if share < settings.pretrain_share:
                hiding = torch.Generator().manual_seed(seed + 2_000_003)
                loss, logs = masked_image_loss(self.model, x, settings.mask_share, hiding)
            else:
                loss, logs = transceiver_loss(self.model, x, draw, noise, settings.loss, with_heads, sent)
        loss.backward()
        norm = self._share_gradients()
        for optimiser in self.optimisers:
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        self.step += 1
        self._update_average()
        return logs | {"loss": loss.detach(), "grad_norm": norm.detach()}

    def ask_to_stop(self) -> None:
        """Stop as soon as all processes know: at once where there is one, else after the next step."""
        self._is_asked_to_stop = True
        self.agreed_stop = self.agreed_stop or self.world == 1

    def _share_gradients(self) -> torch.Tensor:
        """Take the mean of the gradient over all processes, clip it, and return its norm.

        A gradient that is not finite becomes zero. With one process nothing waits for a GPU, which would run
        dry meanwhile.
        """
        # Heads have no gradient in some steps, the same ones in every process.
        weights = [p for p in self.weights if p.grad is not None]
        flat = torch.cat([p.grad.reshape(-1) for p in weights if p.grad is not None])
        if self.world == 1:
            self.agreed_s = self.elapsed_s
        else:
            clock = torch.tensor([self.elapsed_s, float(self._is_asked_to_stop)], device=self.device)
            flat = torch.cat((flat, clock))
            dist.all_reduce(flat)
            flat /= self.world
            self.agreed_s, self.agreed_stop = float(flat[-2]), float(flat[-1]) > 0.0
            flat = flat[:-2]
        norm: torch.Tensor = flat.norm()
        flat = torch.where(norm.isfinite(), flat * (self.settings.clip / norm).clamp(max=1.0), 0.0)
        for weight, part in zip(weights, flat.split([p.numel() for p in weights]), strict=True):
            weight.grad = part.view_as(weight)
        return norm

    @torch.no_grad()
    def _update_average(self) -> None:
        keep = min(self.settings.ema, (1.0 + self.step) / (10.0 + self.step))
        torch._foreach_lerp_(self.averages, self.weights, 1.0 - keep)


def _images_of(folder: Path, flag: str) -> list[NDArray[np.uint8]]:
    try:
        return read_images(folder)
    except SourceError as err:
        raise SourceError(f"{flag} must be a folder of images: {err}") from err
