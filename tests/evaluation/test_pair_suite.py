"""The suite of frame pairs holds what its tables need."""

from pathlib import Path

from semcast.evaluation.pair_suite import RECORDINGS, suite


def test_every_recording_is_measured_without_a_link_too(tmp_path):
    runs = {run.name: run.settings for run in suite(Path("data"), tmp_path, seeds=2)}
    clean = {name: settings for name, settings in runs.items() if settings.codec == "none"}
    assert set(clean) == {f"pairs_{name}_clean" for name in RECORDINGS}
    assert all(len(settings.snr_db) == 1 for settings in clean.values())
