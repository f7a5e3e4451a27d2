"""``semcast train``: train a transceiver, resume where it stopped."""

import argparse
import threading

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

from semcast.commands.console import plain_console
from semcast.commands.running import add_settings, read_settings, run_until_stopped
from semcast.training.loop import Progress as Step
from semcast.training.loop import train
from semcast.training.settings import TrainSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, TrainSettings)


def run(arguments: argparse.Namespace) -> int:
    """Train until done or stopped; Ctrl-C leaves a checkpoint to go on from."""
    settings = read_settings(TrainSettings, arguments)
    talk = plain_console(stderr=True)

    def work(stop: threading.Event) -> None:
        # In a narrow window the figures are cut, and not the number of the step.
        text = TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True))
        columns = (TextColumn("step {task.fields[step]}"), text, BarColumn(10), TimeRemainingColumn())
        bar = Progress(*columns, console=talk, expand=True)
        task = bar.add_task(settings.architecture, total=1.0, step=0)

        def show(step: Step) -> None:
            figures = " ".join(f"{name} {value:.4g}" for name, value in step.values.items())
            bar.update(task, completed=step.share, description=figures, step=step.step)
            bar.start()  # nothing is shown of a run that can't begin

        try:
            result = train(settings, show, stop.is_set)
        finally:
            if bar.live.is_started:  # else it would print an empty line
                bar.stop()
        print(f"{result.weights}: {result.steps} steps in {result.elapsed_s / 60:.0f} min")

    return run_until_stopped(work)
