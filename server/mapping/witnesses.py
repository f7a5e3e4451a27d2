"""What adjustments have left over so far, by keyframe, and how much of it the unknowns took."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.bundle_problem import BundleResult

Array = NDArray[np.float64]


class Witnesses:
    """Keyframes, each with what its residuals say.

    Windows overlap: what a keyframe says again adds to what it said, and makes it no second witness.
    Residuals are less than what was wrong with the observations, to which unknowns were fitted.
    """

    def __init__(self) -> None:
        self._told: dict[int, Array] = {}
        self._num_observed = self._num_fitted = 0

    def __len__(self) -> int:
        return len(self._told)

    @property
    def views(self) -> list[Array]:
        """What each keyframe's residuals say, see ``left_over.information``, in order of time."""
        return [self._told[frame_id] for frame_id in sorted(self._told)]

    @property
    def sigma_factor(self) -> float:
        """By how much estimates scatter more than residuals do, to which unknowns were fitted.

        Infinite where there are as many unknowns as observations: such residuals say nothing.
        """
        share_left = 1.0 - self._num_fitted / self._num_observed if self._num_observed else 1.0
        return share_left**-0.5 if share_left > 0.0 else np.inf

    def note(self, result: BundleResult) -> None:
        """Hear what an adjustment leaves; nothing where it was not asked."""
        if result.left_over is None:
            return
        for frame_id, told in zip(result.problem.keyframe_ids.tolist(), result.left_over, strict=True):
            self._told[frame_id] = self._told.get(frame_id, 0.0) + told
        used = np.isfinite(result.residual_px).all(axis=1)
        num_views, num_points = (len(np.unique(k[used])) for k in (result.problem.view, result.problem.point))
        self._num_observed += 2 * int(used.sum())
        self._num_fitted += 6 * num_views + 3 * num_points
