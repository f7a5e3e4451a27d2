"""What an SNR that is set says about a link whose SNR follows a trace: at most where the trace starts."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from semcast.channel.settings import ChannelSettings
from semcast.channel.trace import SNR_RANGE_DB


def check_snrs(snr_db: Sequence[float], link: ChannelSettings, by_default: Sequence[float] = ()) -> None:
    """Check that SNRs are in range, and that no link would be measured twice.

    Args:
        snr_db: At which a link is measured.
        link: Which.
        by_default: What nobody asked for: of these a link that has its own takes none.

    Raises:
        ValueError: There is none, one is out of range or there twice, or there are several and a file has its
            own.
    """
    low, high = SNR_RANGE_DB
    values = " ".join(f"{value:g}" for value in snr_db) or "none"
    if not snr_db or any(not low <= value <= high for value in snr_db):
        raise ValueError(f"snr_db must be one or more values in [{low:g}, {high:g}], got {values}")
    if len(set(snr_db)) != len(snr_db):
        raise ValueError(f"snr_db must be different values, got {values}")
    if len(snr_db) > 1 and link.has_own_snr and tuple(snr_db) != tuple(by_default):
        raise ValueError(f"snr_db must be a single value with --trace file, which sets the SNR, got {values}")


def stated_snr_db(snr_db: float, link: ChannelSettings) -> float | None:
    """Return the SNR in dB that a result states: as set, None where a file sets it."""
    return None if link.has_own_snr else snr_db


def snr_label(snr_db: float, link: ChannelSettings) -> str:
    """Return what stands for an SNR in a figure: ``6 dB``, ``ramp from 6 dB`` or ``trace``."""
    return replace(link, snr_db=snr_db).snr_label


def snr_file_label(snr_db: float, link: ChannelSettings) -> str:
    """Return ``snr_label`` for the name of a file: ``6db``, ``ramp_from_6db`` or ``trace``."""
    return snr_label(snr_db, link).replace(" dB", "db").replace(" ", "_")


def snr_heading(report: Mapping[str, Any]) -> str | None:
    """Return the name of the column of SNRs in a table of an evaluation's result, None for no column."""
    link = report["settings"].get("link") or {}
    if link.get("channel") != "trace":
        return "SNR dB"
    return None if link.get("trace") == "file" else "start dB"


def trace_notes(report: Mapping[str, Any]) -> list[str]:
    """Return what stands below the table of a result for SNRs that no column has: the name of their file."""
    settings = report.get("settings", {})
    link = settings.get("link") or {}
    is_sent = settings.get("codec") != "none" and (link.get("channel"), link.get("trace")) == (
        "trace",
        "file",
    )
    return [f"SNR and losses are those of {link['trace_file']}."] if is_sent else []


def level_name(snr_db: float | None, report: Mapping[str, Any], unit: str = "") -> str:
    """Name an SNR of a report; None is that of a trace from a file, or stands for original images."""
    if snr_db is None:
        return "no link" if report["settings"]["codec"] == "none" else "trace"
    return f"{snr_db:g}{unit}"
