"""Training images: decoded once, held in memory, cut and changed at random but repeatably."""

import logging
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from semcast.common.errors import SourceError
from semcast.common.image_file import read_image
from semcast.common.layouts.files import IMAGE_SUFFIXES, images_in

logger = logging.getLogger(__name__)

T = TypeVar("T")
#: A whole 16x16 block at half size, from which linear layers start.
MIN_SIDE_PX = 32


@dataclass(frozen=True, kw_only=True)
class CropSettings:
    """How a crop is made.

    Attributes:
        size_px: Side of the crop, a multiple of 16.
        scale_min: Smallest factor a photo is resized by first; reducing hides the traces of JPEG.
        scale_max: Largest; enlarged photos are as smooth as the frames of many cameras.
        share_grey: Share of crops turned grey, since many cameras are.
    """

    size_px: int = field(default=128, metadata={"help": "side of a crop, a multiple of 16"})
    scale_min: float = field(
        default=0.5, metadata={"help": "smallest factor by which a photo is resized first"}
    )
    scale_max: float = field(default=0.9, metadata={"help": "largest such factor"})
    share_grey: float = field(default=0.18, metadata={"help": "share of crops turned grey"})

    def __post_init__(self) -> None:
        if self.size_px < 16 or self.size_px % 16:
            raise ValueError(f"size_px must be a positive multiple of 16, got {self.size_px}")
        if not 0.0 < self.scale_min <= self.scale_max <= 2.0:
            raise ValueError(
                "scale_min and scale_max must be in (0, 2] and ordered, "
                f"got {self.scale_min}, {self.scale_max}"
            )
        if not 0.0 <= self.share_grey <= 1.0:
            raise ValueError(f"share_grey must be in [0, 1], got {self.share_grey}")


def read_images(folder: Path) -> list[NDArray[np.uint8]]:
    """Read all images of a folder as ``(H, W, 3)`` uint8 RGB, by name, as an agent would read them.

    Those that can't be read are left out, with a warning each.

    Raises:
        SourceError: The folder can't be read or holds no readable image, or one is too small.
    """
    images: list[NDArray[np.uint8]] = []
    # Not in the natural order of their names: which crops a seed draws goes by this one.
    for path in sorted(images_in(folder)):
        try:
            image = read_image(path)
        except SourceError as err:
            logger.warning("left out: %s", err)
            continue
        height, width = image.shape[:2]
        if min(height, width) < MIN_SIDE_PX:
            raise SourceError(
                f"images must have sides of at least {MIN_SIDE_PX} pixels, {path} is {width}x{height}"
            )
        images.append(image)
    if not images:
        raise SourceError(f"{folder} holds no readable image ({', '.join(IMAGE_SUFFIXES)})")
    return images


def random_crop(
    image: NDArray[np.uint8], settings: CropSettings, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Resize, cut, mirror, turn, and sometimes change contrast or colour; ``(size, size, 3)`` uint8."""
    size = settings.size_px
    smallest = size / min(image.shape[:2])
    scale = max(smallest, rng.uniform(settings.scale_min, settings.scale_max))
    source = min(round(size / scale), *image.shape[:2])
    row = int(rng.integers(image.shape[0] - source + 1))
    column = int(rng.integers(image.shape[1] - source + 1))
    cut = image[row : row + source, column : column + source]
    how = cv2.INTER_AREA if source > size else cv2.INTER_CUBIC
    crop = cv2.resize(cut, (size, size), interpolation=how) if source != size else cut
    crop = np.rot90(crop, int(rng.integers(4)))
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    if rng.random() < settings.share_grey:
        crop = np.repeat(cv2.cvtColor(np.ascontiguousarray(crop), cv2.COLOR_RGB2GRAY)[:, :, None], 3, axis=2)
    if rng.random() < 0.3:
        contrast, brightness = rng.uniform(0.7, 1.25), rng.uniform(-25.0, 25.0)
        crop = np.clip((crop.astype(np.float32) - 128.0) * contrast + 128.0 + brightness, 0, 255).astype(
            np.uint8
        )
    return np.ascontiguousarray(crop, dtype=np.uint8)


class Crops(Dataset[Tensor]):
    """The batch of every step, a function of seed, step and rank alone.

    Args:
        images: From ``read_images``.
        settings: How crops are made.
        batch: Crops in a batch.
        seed: Of the whole run.
        rank: Of this process.
    """

    def __init__(
        self, images: list[NDArray[np.uint8]], settings: CropSettings, batch: int, seed: int, rank: int = 0
    ) -> None:
        self._images = images
        self._settings = settings
        self._batch = batch
        self._key = (seed, rank)

    def __getitem__(self, step: int) -> Tensor:
        """Return the batch of a step, ``(B, 3, size, size)`` uint8."""
        rng = np.random.default_rng((*self._key, step))
        chosen = rng.integers(len(self._images), size=self._batch)
        crops = [random_crop(self._images[k], self._settings, rng) for k in chosen]
        return torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2)


class Ahead(Generic[T]):
    """What the steps are made of, prepared ahead of its use.

    Args:
        items: Makes it, by step.
        workers: What does so: 1 is a thread beside the one that trains, more are processes. Items are the
            same for any number.
        pinned: Items are left in memory from which a GPU fetches them on its own.

    Raises:
        ValueError: ``workers`` is less than 1.
    """

    def __init__(self, items: Dataset[T], workers: int = 1, pinned: bool = False) -> None:
        if workers < 1:
            raise ValueError(f"workers must be >= 1, got {workers}")
        self._items = items
        self._workers, self._pinned = workers, pinned
        self._next_step = -1
        self._ahead: Iterator[T] = iter(())

    def get(self, step: int) -> T:
        """Return the item of a step and start on the next ones."""
        if step != self._next_step:
            self.close()
            self._ahead = self._by_processes(step) if self._workers > 1 else self._by_thread(step)
        self._next_step = step + 1
        return next(self._ahead)

    def _by_processes(self, step: int) -> Iterator[T]:
        return iter(
            DataLoader(
                self._items,
                batch_size=None,
                sampler=range(step, sys.maxsize),
                num_workers=self._workers,
                pin_memory=self._pinned,
                worker_init_fn=_one_thread,
            )
        )

    def _by_thread(self, step: int) -> Iterator[T]:
        with ThreadPoolExecutor(1, thread_name_prefix="ahead") as pool:
            ahead = pool.submit(self._items.__getitem__, step)
            for k in count(step + 1):
                item = ahead.result()
                ahead = pool.submit(self._items.__getitem__, k)
                yield item

    def close(self) -> None:
        """Stop what prepares items."""
        self._ahead = iter(())
        self._next_step = -1


def _one_thread(worker: int) -> None:
    # A forked process has none of its parent's threads, which OpenCV would wait for.
    cv2.setNumThreads(0)
