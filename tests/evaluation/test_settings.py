"""Every settings class of an evaluation can be filled from flags, and its command line reads back."""

import argparse
import dataclasses
import shlex
from pathlib import Path

import pytest

from semcast.common.config_flags import add_flags, settings_from
from semcast.evaluation import confidence, latency, pairs, trajectory
from semcast.evaluation.report import command_line

VERBS = [
    (confidence, confidence.ConfidenceSettings),
    (latency, latency.LatencySettings),
    (pairs, pairs.PairSettings),
    (trajectory, trajectory.TrajectorySettings),
]


def parser_of(module, cls):
    parser = argparse.ArgumentParser()
    add_flags(parser, cls, module.UNUSED_FIELDS)
    return parser


@pytest.mark.parametrize(("module", "cls"), VERBS)
def test_the_command_of_a_result_gives_the_same_settings(module, cls):
    words = ["--sequence", "room", "--snr-db", "4", "--channel", "erasure", "--slot-loss", "0.1"]
    words += ["--seed", "3", "--fx", "100", "--fy", "100", "--cx", "1", "--cy", "2", "--resize", "0.5"]
    parser = parser_of(module, cls)
    settings = settings_from(cls, parser.parse_args(words))
    assert settings.sequence == Path("room")
    assert settings.snr_db == (4.0,)
    assert settings.link.slot_loss == 0.1
    line = command_line(module.VERB, settings)
    assert line.startswith(f"semcast {module.VERB} ")
    flags = shlex.split(line)[1 + len(module.VERB.split()) :]
    assert settings_from(cls, parser.parse_args(flags)) == settings


@pytest.mark.parametrize(("module", "cls"), VERBS)
def test_every_flag_is_explained(module, cls):
    def leaves(owner, prefix=""):
        for field in dataclasses.fields(owner):
            nested = field.default if dataclasses.is_dataclass(field.default) else None
            if nested is not None:
                yield from leaves(type(nested), f"{prefix}{field.name}.")
            elif prefix + field.name not in module.UNUSED_FIELDS:
                yield prefix + field.name, field

    fields = list(leaves(cls))
    assert len(fields) > 20
    assert [name for name, field in fields if not field.metadata.get("help")] == []
