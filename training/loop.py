"""The training loop: one process or several under torchrun, on CPU or GPU, resumable at any step."""

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist

from semcast.common.errors import SemcastError
from semcast.training.curve import CURVE_NAME, append_row, append_validation, cut_to_step, mean_of
from semcast.training.run import Run
from semcast.training.settings import TrainSettings
from semcast.training.validation import validate

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Progress:
    """What a run reports while it goes on.

    Attributes:
        step: Steps done.
        elapsed_s: Training time over all resumed parts.
        share: Share of the run that is done.
        values: Means since the last report: loss, PSNR of crops, and so on.
    """

    step: int
    elapsed_s: float
    share: float
    values: dict[str, float]


@dataclass(frozen=True)
class TrainResult:
    """How a run ended.

    Attributes:
        steps: Steps done.
        elapsed_s: Training time over all resumed parts.
        weights: The file of averaged weights.
        valid: Last validation, empty without validation images.
    """

    steps: int
    elapsed_s: float
    weights: Path
    valid: dict[str, float]


def train(
    settings: TrainSettings,
    on_progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> TrainResult:
    """Train until the steps or the minutes are done, or until asked to stop; always ends with a checkpoint.

    Under torchrun every process takes its own crops and gradients are averaged. ``out`` receives ``last.pt``
    (everything needed to go on), ``log.jsonl`` (the curve) and the averaged weights with their manifest.

    Args:
        settings: Of the run.
        on_progress: Called after the first step and every ``log_every`` steps, in the first process.
        should_stop: Asked before every step; with several processes the first one to say so stops all.

    Raises:
        SourceError: There are no images.
        CheckpointError: The checkpoint in ``out`` belongs to another architecture or other optimisers, or is
            damaged.
        ConfigError: ``start`` or ``grow_from`` does not suit the architecture.
        SemcastError: Checkpoint, curve or weights can't be written, or losses or weights aren't finite;
            what was there before stays.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    joined = world > 1 and not dist.is_initialized()
    if joined:
        use_cuda = settings.device != "cpu" and torch.cuda.is_available()
        dist.init_process_group("nccl" if use_cuda else "gloo")
    if settings.threads:
        torch.set_num_threads(settings.threads)
    try:
        return _train(Run(settings, dist.get_rank() if world > 1 else 0, world), on_progress, should_stop)
    except OSError as err:
        raise SemcastError(f"training into {settings.out} ended: {err}") from err
    finally:
        if joined:
            dist.destroy_process_group()


def _train(
    run: Run, on_progress: Callable[[Progress], None] | None, should_stop: Callable[[], bool] | None
) -> TrainResult:
    settings, log = run.settings, run.settings.out / CURVE_NAME
    rows: list[dict[str, torch.Tensor]] = []
    valid: dict[str, float] = {}
    is_first = True
    logger.info("training %s from step %d on %s", settings.architecture, run.step, run.device)
    if run.rank == 0:
        cut_to_step(log, run.step)
    try:
        while run.share_done() < 1.0:
            if should_stop is not None and should_stop():
                run.ask_to_stop()
            if run.agreed_stop:
                break
            start_s = time.perf_counter()
            row = run.one_step()
            if run.rank == 0:  # the others log nothing
                rows.append(row)
                run.divergence.add(run.step, row["loss"])
            run.elapsed_s += time.perf_counter() - start_s
            is_logged, is_saved = run.step % settings.log_every == 0, run.step % settings.save_every == 0
            if run.rank == 0 and (is_logged or is_saved) and run.breakdown() is not None:
                run.ask_to_stop()
                continue
            if run.rank == 0 and (is_logged or is_first):
                report = Progress(run.step, run.elapsed_s, run.share_done(), mean_of(rows))
                if is_logged:
                    rows.clear()
                    append_row(
                        log, {"step": report.step, "elapsed_s": round(report.elapsed_s, 1), **report.values}
                    )
                if on_progress is not None:
                    on_progress(report)
            is_first = False
            is_end = run.share_done() >= 1.0  # which is validated below
            if run.step % settings.valid_every == 0 and run.valid_images and run.rank == 0 and not is_end:
                valid = validate(run.shippable(), run.valid_images, run.device, run.bf16)
                append_validation(log, run.step, run.elapsed_s, valid)
            if is_saved and run.divergence.is_newest_finite():
                run.save()
    finally:
        run.ahead.close()
        run.save()
    weights = settings.out / f"{settings.architecture}.safetensors"
    if run.rank == 0:
        _check(run)
        logger.info("step %d was the last; the weights are averaged, validated and written", run.step)
        model = run.shippable()  # as long as some dozens of steps take
        if run.valid_images:
            valid = validate(model, run.valid_images, run.device, run.bf16)
            append_validation(log, run.step, run.elapsed_s, valid)
        weights = run.export(model, valid)
    return TrainResult(run.step, run.elapsed_s, weights, valid)


def _check(run: Run) -> None:
    broken = run.breakdown()
    if broken is not None:
        saved = "no checkpoint was written"
        if run.saved_step is not None:
            saved = f"the checkpoint of step {run.saved_step} stays"
        raise SemcastError(
            f"training into {run.settings.out} broke down by step {run.step}: {broken}; {saved}"
        )
