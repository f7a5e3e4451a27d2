"""Settings of an agent are checked before anything is opened."""

import pytest

from semcast.agent.settings import AgentSettings
from semcast.agent.source_settings import SourceSettings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": SourceSettings(source="x", pace="receiver")}, "pace 'receiver' needs mode 'replay'"),
        ({"threads": 0}, r"threads must be in \[1, 1024\], got 0"),
        ({"snr_db": 500.0}, r"snr_db must be in \[.*\], got 500"),
        ({"agent_id": "a/b"}, "agent_id must be"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        AgentSettings(**{"source": SourceSettings(source="x"), **changes})
