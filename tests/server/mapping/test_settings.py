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
