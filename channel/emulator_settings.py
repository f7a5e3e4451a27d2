"""Settings of the channel process."""

from dataclasses import dataclass, field

from semcast.channel.settings import ChannelSettings
from semcast.common.keys import DEFAULT_AGENT_ID, check_agent_id
from semcast.common.network_settings import NetworkSettings


@dataclass(frozen=True, kw_only=True)
class EmulatorSettings:
    """The channel process: which stream, which channel, where the others are.

    Raises:
        ValueError: A value is out of range.
    """

    agent_id: str = field(default=DEFAULT_AGENT_ID, metadata={"help": "name of the agent to serve"})
    seed: int = field(default=0, metadata={"help": "seed of all randomness of the channel"})
    link: ChannelSettings = field(default=ChannelSettings(), metadata={"help": "the channel"})
    network: NetworkSettings = field(default=NetworkSettings(), metadata={"help": "where the hub is"})

    def __post_init__(self) -> None:
        check_agent_id(self.agent_id)
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")
