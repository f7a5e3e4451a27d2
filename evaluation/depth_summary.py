"""What confidence does to depth maps where the true depth is known: a part of ``docs/confidence.md``."""

from collections.abc import Mapping
from typing import Any

from semcast.evaluation.markdown import table

#: Whose rows.
_CODEC = "3dcsc"


def depth_summary(report: Mapping[str, Any]) -> str:
    """Return coverage, wrong depths and the median error with confidence and without as a Markdown table.

    Args:
        report: A result of ``semcast eval depth`` with both modes.
    """
    of = {
        (row["snr_db"], row["confidence"]): row
        for row in report["results"]
        if row["codec"] == _CODEC and row["coverage"]
    }
    snrs_db = sorted({snr_db for snr_db, mode in of if mode == "on" and (snr_db, "off") in of})
    figures = {"coverage": ".1%", "outlier_share": ".1%", "median_error": ".2%"}
    rows = [
        [
            f"{snr_db:g} dB",
            *(
                format(of[snr_db, mode][name], form)
                for name, form in figures.items()
                for mode in ("on", "off")
            ),
        ]
        for snr_db in snrs_db
    ]
    names = ("pixels with a depth", "of these off by more than 5 %", "median error")
    head = [_CODEC, *(f"{name}{mode}" for name in names for mode in ("", ", without confidence"))]
    return "\n".join(table(head, rows))
