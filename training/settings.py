"""Settings of a training run."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from semcast.common.codec import Device
from semcast.training.allocations import AllocationSettings
from semcast.training.channel import LinkDrawSettings
from semcast.training.data import CropSettings
from semcast.training.losses import LossSettings

#: The seed of a step is made of this one, the step and the process, and has 63 bits.
_MAX_SEED = 2**32 - 1


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """One training run, reproducible from these values, the data and the number of processes.

    But for one that ends by ``minutes``: its learning rate follows the clock.
    """

    architecture: str = field(default="3dcsc-lite", metadata={"help": "architecture from the registry"})
    data: Path = field(default=Path("data/train"), metadata={"help": "folder of training images"})
    valid: Path | None = field(default=None, metadata={"help": "folder of images to validate on"})
    out: Path = field(
        default=Path("checkpoints/3dcsc-lite"), metadata={"help": "folder of checkpoint and log"}
    )
    steps: int = field(default=100_000, metadata={"help": "optimiser steps"})
    minutes: float = field(
        default=0.0, metadata={"help": "end after so many minutes even if steps are left; 0: no limit"}
    )
    warmup_steps: int = field(default=300, metadata={"help": "steps of linear warm-up"})
    decay_share: float = field(
        default=0.25, metadata={"help": "last share of the run, over which the learning rate falls to 0"}
    )
    batch: int = field(default=16, metadata={"help": "crops per step and process"})
    optimiser: Literal["muon", "adamw"] = field(
        default="muon", metadata={"help": "optimiser of convolution kernels"}
    )
    lr: float = field(default=1e-3, metadata={"help": "learning rate of AdamW"})
    lr_muon: float = field(default=0.006, metadata={"help": "learning rate of Muon"})
    lr_linear: float = field(default=2e-4, metadata={"help": "learning rate of the linear transform"})
    weight_decay: float = field(
        default=1.0, metadata={"help": "decay of Muon's kernels: holds their largest gain near 1 / decay"}
    )
    clip: float = field(default=0.01, metadata={"help": "norm to which gradients are clipped"})
    ema: float = field(default=0.999, metadata={"help": "decay of the averaged weights that are shipped"})
    start: Literal["klt", "random"] = field(
        default="klt",
        metadata={"help": "first weights of linear layers; klt: the Karhunen-Loeve transform of the images"},
    )
    grow_from: Path | None = field(
        default=None,
        metadata={
            "help": "start as a trained network of this very size, or a smaller 3dcsc one, or one of fixed "
            "rate and this size where the rate is variable; a weights file"
        },
    )
    pretrain_share: float = field(
        default=0.0,
        metadata={"help": "first share of the run, spent on filling in hidden patches without a link (mae)"},
    )
    analog_share: float = field(
        default=0.0,
        metadata={
            "help": "until this share of the run all images are sent analog: rounding to levels hides from a "
            "randomly started network what it could gain"
        },
    )
    mask_share: float = field(default=0.75, metadata={"help": "share of patches hidden in pre-training"})
    head_every: int = field(
        default=4,
        metadata={
            "help": "train the confidence heads every N steps, in every step of the decay's last quarter"
        },
    )
    only_heads: bool = field(
        default=False,
        metadata={
            "help": "train nothing but the confidence heads of the network of --grow-from: the images it "
            "decodes stay the same to the bit"
        },
    )
    seed: int = field(default=0, metadata={"help": "seed of weights, data order and links"})
    device: Device = field(default="auto", metadata={"help": "device to train on"})
    bf16: bool = field(default=True, metadata={"help": "bfloat16 autocast where the hardware has it"})
    compile: bool = field(
        default=False,
        metadata={"help": "torch.compile encoder and decoder: a minute at first, faster steps on a GPU"},
    )
    threads: int = field(default=0, metadata={"help": "CPU threads; 0: torch decides"})
    data_workers: int = field(
        default=1, metadata={"help": "processes that cut crops (1: a thread); about 8 keep one GPU busy"}
    )
    log_every: int = field(default=50, metadata={"help": "steps between log lines"})
    valid_every: int = field(default=2000, metadata={"help": "steps between validations"})
    save_every: int = field(default=1000, metadata={"help": "steps between checkpoints"})
    resume: bool = field(
        default=True, metadata={"help": "continue from the checkpoint in --out, if there is one"}
    )
    crop: CropSettings = field(default_factory=CropSettings)
    channel: LinkDrawSettings = field(default_factory=LinkDrawSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    allocation: AllocationSettings = field(default_factory=AllocationSettings)

    def __post_init__(self) -> None:
        for name in (
            "steps",
            "batch",
            "data_workers",
            "head_every",
            "log_every",
            "valid_every",
            "save_every",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, got {getattr(self, name)}")
        for name in ("warmup_steps", "minutes", "threads", "weight_decay"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be >= 0, got {getattr(self, name)}")
        for name in ("lr", "lr_muon", "lr_linear", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}")
        if not 0 <= self.seed <= _MAX_SEED:
            raise ValueError(f"seed must be in [0, {_MAX_SEED}], got {self.seed}")
        if self.only_heads and self.grow_from is None:
            raise ValueError("grow_from must name the weights whose heads are trained when only_heads is set")
        if self.only_heads and self.loss.confidence == 0.0:
            raise ValueError("loss.confidence must be > 0 when only_heads is set, got 0")
        if not 0.0 < self.mask_share < 1.0:
            raise ValueError(f"mask_share must be in (0, 1), got {self.mask_share}")
        for name in ("decay_share", "ema", "pretrain_share", "analog_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
