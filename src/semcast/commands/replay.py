"""``semcast replay``: reconstruct again from a recording, as received or through another channel."""

import argparse
import threading
from dataclasses import replace
from typing import Any

from rich.text import Text

from semcast.commands.console import plain_console
from semcast.commands.demo import summary_table, why_no_pose
from semcast.commands.running import add_settings, read_given, read_settings, run_until_stopped
from semcast.common.config_flags import given_values
from semcast.common.run_folder import files_of_run
from semcast.server.replay import ReplaySettings, replay

#: A recording is replayed in order and at once; the seed is that of channel and estimation alike.
_UNUSED = frozenset({"link.delay_ms", "link.jitter_ms", "reconstruction.seed"})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, ReplaySettings, _UNUSED)


def settings_of(arguments: argparse.Namespace) -> ReplaySettings:
    """Return the settings that were given; a channel that is asked for takes what the agent sent.

    Also one asked for by its default values, and by flags beside a file of a replay as received.
    """
    typed = given_values(ReplaySettings, arguments, skip=_UNUSED)
    if "link" in typed and "symbols" not in typed:
        arguments.symbols = "transmitted"
    settings = read_settings(ReplaySettings, arguments)
    if settings.symbols is None and "link" in read_given(ReplaySettings, arguments):
        return replace(settings, symbols="transmitted")
    return settings


def run(arguments: argparse.Namespace) -> int:
    """Replay and print the figures."""
    settings = settings_of(arguments)
    talk = plain_console(stderr=True)
    summary: dict[str, Any] = {}

    def work(stop: threading.Event) -> None:
        with talk.status(Text(f"replaying {settings.file}")) as status:

            def show(text: str) -> None:
                status.update(Text(f"replaying {settings.file}: {text}"))

            summary.update(replay(settings, stop, lambda k: show(f"frame {k}"), show))

    code = run_until_stopped(work)
    plain_console().print(summary_table(summary))
    if settings.out is not None:
        print(f"in {settings.out}: {', '.join(file.name for file in files_of_run(settings.out))}")
    if not code and not summary.get("completeness"):
        talk.print(f"semcast replay: {why_no_pose(summary)}", soft_wrap=True)
        return 1
    return code
