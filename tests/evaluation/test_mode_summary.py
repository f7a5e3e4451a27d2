"""Three modes compared two by two, over recordings that have all of them."""

from semcast.evaluation.mode_summary import mode_summary

FIGURES = ("ate_percent", "ate_at_once_percent", "rpe_trans_percent", "rpe_rot_deg")


def report(name, snr_db=2.0, **errors):
    """A recording with an error in each of some modes, of three seeds of which each errs twice as much."""
    return {
        "sequence": name,
        "cells": [
            {
                "confidence": mode,
                "snr_db": snr_db,
                "runs": [{"seed": k, **dict.fromkeys(FIGURES, error * 2.0**k)} for k in range(3)],
            }
            for mode, error in errors.items()
        ],
    }


def test_modes_of_one_recording_may_be_in_two_files_and_none_may_lack():
    reports = [report(f"room {k}", robust=0.6 + 0.1 * k, off=1.0 + k) for k in range(5)]
    reports += [report(f"room {k}", shuffled=0.8 + 0.1 * k) for k in range(5)]
    reports.append(report("without shuffled", robust=9.0, off=1.0))
    reports.append(report("room 1", snr_db=6.0, robust=9.0, off=1.0))
    head, _, path, live, *_ = mode_summary(reports).splitlines()
    assert head == "| error, 5 recordings | `robust` / `off` | `shuffled` / `off` | `robust` / `shuffled` |"
    # (.6 .7 .8 .9 1)^(1/5) is .788, (.8 .9 1 1.1 1.2)^(1/5) .990, and (1 2 3 4 5)^(1/5) 2.605.
    assert [cell.split()[0] for cell in path.split(" | ")[1:]] == ["0.30", "0.38", "0.80"]
    assert live.startswith("| path, live |")
