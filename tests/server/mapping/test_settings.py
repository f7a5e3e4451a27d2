"""Settings of the reconstruction that can not be are refused by name."""

import pytest

from semcast.server.mapping.settings import ReconstructionSettings


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"confidence": "maybe"}, "confidence must be one of"),
        ({"max_features": 3}, r"max_features must be in \[50, 5000\], got 3"),
        ({"window_size": 2}, "window_size"),
        ({"beta": 9.0}, "beta"),
        ({"seed": -1}, "seed"),
        ({"readout_ms": -1.0}, r"readout_ms must be in \[0, 100\], got -1"),
        ({"readout_ms": float("nan")}, "readout_ms must be in"),
        ({"readout_from": "up"}, "readout_from must be one of top, bottom, left, right"),
    ],
)
def test_settings_are_checked(values, message):
    with pytest.raises(ValueError, match=message):
        ReconstructionSettings(**values)


def test_a_map_is_given_up_after_a_time_and_not_before_some_frames():
    settings = ReconstructionSettings(lost_after_s=0.4)
    at = [k * 10**8 for k in range(6)]
    assert not settings.gives_up([])
    assert not settings.gives_up(at[:4])
    assert settings.gives_up(at[:5])
    assert not settings.gives_up([0, 10**10]), "two frames are too few chances, however long they took"
    assert ReconstructionSettings(lost_after_s=0.0).gives_up(at[:3])


def test_a_map_of_a_camera_that_rested_is_given_up_later():
    at = [k * 10**8 for k in range(32)]
    settings = ReconstructionSettings(lost_after_s=0.4)
    assert settings.gives_up(at[:30])
    assert not settings.gives_up(at[:30], rested=True)
    assert settings.gives_up(at[:31], rested=True)
    assert not ReconstructionSettings(lost_after_s=5.0).gives_up(at, rested=True)
