"""What the residuals of all adjustments so far say about shutter and lens, by keyframe."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.bundle_problem import BundleResult

Array = NDArray[np.float64]


class Witnesses:
    """Collects ``left_over.information`` of keyframes.

    Windows overlap: what a keyframe says in several adjustments is added up, and it stays one independent
    witness. Also counts observations and unknowns, since unknowns that were fitted to the observations have
    made residuals smaller than the errors they stand for.
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
        """Factor on standard deviations for the degrees of freedom that fitted unknowns have taken.

        Infinite where there are as many unknowns as observations: such residuals say nothing.
        """
        share_left = 1.0 - self._num_fitted / self._num_observed if self._num_observed else 1.0
        return share_left**-0.5 if share_left > 0.0 else np.inf

    def note(self, result: BundleResult) -> None:
        """Add the residuals of an adjustment, if it was asked for their information."""
        if result.left_over is None:
            return
        for frame_id, told in zip(result.problem.keyframe_ids.tolist(), result.left_over, strict=True):
            self._told[frame_id] = self._told.get(frame_id, 0.0) + told
        used = np.isfinite(result.residual_px).all(axis=1)
        num_views, num_points = (len(np.unique(k[used])) for k in (result.problem.view, result.problem.point))
        self._num_observed += 2 * int(used.sum())
        self._num_fitted += 6 * num_views + 3 * num_points
