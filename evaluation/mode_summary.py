"""What of the gain on paths is confidence itself: part of ``docs/confidence.md``.

``off`` lacks more than confidence: it does not know the shape of errors either. ``shuffled`` knows it, and
gives each point the confidence of another one.
"""

from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any

import numpy as np

from semcast.evaluation.link_summary import FIGURES, log_ratios
from semcast.evaluation.markdown import table, with_interval
from semcast.evaluation.statistics import mean_ratio

Report = Mapping[str, Any]

#: Errors of the first mode over those of the second.
_COMPARED = (("robust", "off"), ("shuffled", "off"), ("robust", "shuffled"))


def mode_summary(reports: Iterable[Report]) -> str:
    """Return the table as Markdown: geometric means over recordings, a mode over another, run by run.

    Args:
        reports: Results of ``semcast eval trajectory``, of which one SNR has all of the modes, in one file or
            several. At least five recordings; what lacks a mode is left out.
    """
    of_recording: dict[tuple[str, float], dict[str, dict[int, Report]]] = {}
    for report in reports:
        for cell in report["cells"]:
            modes = of_recording.setdefault((report["sequence"], cell["snr_db"]), {})
            modes[cell["confidence"]] = {run["seed"]: run for run in cell["runs"]}
    wanted = set(chain(*_COMPARED))
    whole = [modes for modes in of_recording.values() if wanted <= modes.keys()]
    ratios = [
        [
            log_ratios([(modes[ours][seed], modes[theirs][seed]) for seed in modes[ours]]).mean(axis=0)
            for modes in whole
        ]
        for ours, theirs in _COMPARED
    ]
    heads = [f"`{ours}` / `{theirs}`" for ours, theirs in _COMPARED]
    rows = [
        [name, *(with_interval(*mean_ratio([np.stack(means)[:, k]])) for means in ratios)]
        for k, name in enumerate(FIGURES.values())
    ]
    return "\n".join(table([f"error, {len(whole)} recordings", *heads], rows)) + "\n"
