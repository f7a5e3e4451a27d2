"""One cell of a pair benchmark: errors of all methods on the same pairs, AUROC of cues, comparisons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.evaluation.pose_error import PoseError, summarise_pose_errors
from semcast.evaluation.statistics import auroc, paired_bootstrap, percentiles

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PairOutcome:
    """What was measured on one pair under one seed.

    Attributes:
        errors: Method -> error.
        cpu_ms: Method -> processor time of the estimation alone.
        num_matches: Matches every method was given.
        cues: Cue -> ``(N,)`` score per match, higher means more trusted.
        true_inlier: Kind of truth -> ``(N,)`` bool.
    """

    errors: Mapping[str, PoseError]
    cpu_ms: Mapping[str, float]
    num_matches: int
    cues: Mapping[str, NDArray[np.float32]]
    true_inlier: Mapping[str, NDArray[np.bool_]]


class PairCell:
    """Collects the outcomes of one SNR over pairs and seeds.

    Args:
        methods: Names of all methods, in the order of the report.
    """

    def __init__(self, methods: Sequence[str]) -> None:
        self._methods = list(methods)
        self._outcomes: dict[tuple[int, int], PairOutcome] = {}

    def add(self, pair_idx: int, seed: int, outcome: PairOutcome) -> None:
        """Take the outcome of a pair under a seed.

        Raises:
            ValueError: It was taken before, or lacks a method.
        """
        if (pair_idx, seed) in self._outcomes:
            raise ValueError(f"pair {pair_idx} under seed {seed} was added before")
        missing = [m for m in self._methods if m not in outcome.errors]
        if missing:
            raise ValueError(f"outcome must have all methods, missing {', '.join(missing)}")
        self._outcomes[pair_idx, seed] = outcome

    @property
    def outcomes(self) -> list[PairOutcome]:
        """All outcomes, ordered by pair and seed."""
        return [self._outcomes[key] for key in sorted(self._outcomes)]

    def errors(self, method: str) -> dict[str, Array]:
        """Return ``rot_deg``, ``tdir_deg``, ``failed``, each ``(num_pairs, num_seeds)``.

        Of the seeds that all pairs have: a measurement that was interrupted has done some pairs of its last.
        """
        pairs = sorted({pair for pair, _ in self._outcomes})
        seeds = sorted({seed for _, seed in self._outcomes})
        seeds = [s for s in seeds if all((p, s) in self._outcomes for p in pairs)]
        shape = (len(pairs), len(seeds))
        grid = [self._outcomes[p, s].errors[method] for p in pairs for s in seeds]
        return {name: values.reshape(shape) for name, values in _columns(grid).items()}

    def results(self) -> dict[str, dict[str, Any]]:
        """Return per method the summary of its errors and ``cpu_ms``, over all outcomes."""
        summary = {}
        for method in self._methods:
            errors = _columns([o.errors[method] for o in self.outcomes])
            times = [o.cpu_ms[method] for o in self.outcomes if method in o.cpu_ms]
            summary[method] = {**summarise_pose_errors(errors), "cpu_ms": percentiles(times)}
        return summary

    def auroc_of_cues(self) -> dict[str, dict[str, float | None]]:
        """Return, per kind of truth and cue, how well the cue tells true inliers, over all matches.

        A cue that some pair lacks is left out.
        """
        with_matches = [o for o in self.outcomes if o.num_matches > 0]
        if not with_matches:
            return {}
        found: dict[str, dict[str, float | None]] = {}
        for kind in dict.fromkeys(kind for o in with_matches for kind in o.true_inlier):
            labelled = [o for o in with_matches if kind in o.true_inlier]
            positive = np.concatenate([o.true_inlier[kind] for o in labelled])
            shared = [cue for cue in labelled[0].cues if all(cue in o.cues for o in labelled)]
            found[kind] = {
                cue: auroc(np.concatenate([o.cues[cue] for o in labelled]), positive) for cue in shared
            }
        return found

    def inlier_share(self, kind: str) -> float | None:
        """Return the share of matches that are true inliers; None without matches."""
        labels = [o.true_inlier[kind] for o in self.outcomes if o.num_matches > 0]
        return float(np.concatenate(labels).mean()) if labels else None

    def comparisons(
        self, modes: Sequence[str], rivals: Sequence[str], rng: np.random.Generator, block: int
    ) -> list[dict[str, Any]]:
        """Return paired differences of the mean errors of each mode to each rival with 95 % intervals.

        Pairs are resampled with all their seeds, ``block`` neighbours at a time (see ``paired_bootstrap``).
        """
        found = []
        for mode in modes:
            for rival in rivals:
                if mode == rival:
                    continue
                ours, theirs = self.errors(mode), self.errors(rival)
                found += [
                    {
                        "mode": mode,
                        "against": rival,
                        "figure": f"{name}_mean",
                        "paired": paired_bootstrap(ours[name], theirs[name], rng, block=block),
                    }
                    for name in ("rot_deg", "tdir_deg")
                ]
        return found


def _columns(errors: Sequence[PoseError]) -> dict[str, Array]:
    """Return errors ``(N,)`` by figure."""
    return {name: np.array([getattr(e, name) for e in errors]) for name in ("rot_deg", "tdir_deg", "failed")}


def merge_cells(methods: Sequence[str], cells: Sequence[PairCell]) -> PairCell:
    """Return one cell with the outcomes of all: the figures over all SNRs together."""
    merged = PairCell(methods)
    for cell_idx, cell in enumerate(cells):
        for (pair_idx, seed), outcome in cell._outcomes.items():
            merged.add(cell_idx * 1_000_000 + pair_idx, seed, outcome)
    return merged
