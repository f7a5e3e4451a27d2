"""``semcast record``: keep everything a running system sends in one file."""

import argparse
import sys
import threading

from semcast.commands.running import add_settings, read_settings, run_until_stopped
from semcast.server.record import RecordSettings, run_record


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, RecordSettings)


def run(arguments: argparse.Namespace) -> int:
    """Record until stopped; Ctrl-C is the usual end."""
    settings = read_settings(RecordSettings, arguments)

    def work(stop: threading.Event) -> None:
        done = run_record(settings, stop)
        if not done["messages"] and not done["drops"]:
            print("nothing was recorded: no message came before the end", file=sys.stderr)
            return
        dropped = f", {sum(done['drops'].values())} dropped" if done["drops"] else ""
        print(f"{settings.file}: {done['messages']} messages, {done['bytes'] / 1e6:.1f} MB{dropped}")

    return run_until_stopped(work)
