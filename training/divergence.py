"""Tells a training that has broken down from one bad batch, which spoils nothing."""

import math

import torch
from torch import Tensor

#: So many losses in a row that are not finite are no bad batch.
_MAX_BAD = 10
#: Weights are shipped in half precision.
_MAX_WEIGHT = torch.finfo(torch.float16).max


class Divergence:
    """The losses of a run as far as they tell that it has broken down.

    They stay on their device until somebody asks: a GPU need not be waited for in every step.
    """

    def __init__(self) -> None:
        self._unseen: list[tuple[int, Tensor]] = []
        self._last: tuple[int, float] | None = None
        self._num_bad = 0

    def add(self, step: int, loss: Tensor) -> None:
        """Take the loss of a step."""
        self._unseen.append((step, loss))

    def is_newest_finite(self) -> bool:
        """Return whether the newest loss is finite; so is none at all."""
        if self._unseen:
            values = torch.stack([loss.float() for _, loss in self._unseen]).tolist()
            for (step, _), value in zip(self._unseen, values, strict=True):
                is_finite = math.isfinite(value)
                self._num_bad = 0 if is_finite else self._num_bad + 1
                self._last = (step, value) if is_finite else self._last
            self._unseen.clear()
        return self._num_bad == 0

    def found_in(self, weights: list[Tensor]) -> str | None:
        """Return what is broken and which loss was the last finite one, None where the run can go on.

        Args:
            weights: Of the model and of its average.
        """
        self.is_newest_finite()
        largest = torch.stack(torch._foreach_norm(weights, math.inf)).max()
        if bool(largest <= _MAX_WEIGHT):  # which what is not a number is not
            if self._num_bad < _MAX_BAD:
                return None
            what = f"the last {self._num_bad} losses are not finite"
        else:
            what = "weights are not finite in half precision"
        if self._last is None:
            return f"{what}, no loss was"
        return f"{what}, the last finite loss was {self._last[1]:.4g} in step {self._last[0]}"
