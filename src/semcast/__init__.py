"""Live 3D reconstruction over a link too poor for video."""

import logging

from semcast.common.errors import (
    CheckpointError,
    ConfigError,
    ProtocolError,
    SemcastError,
    SourceError,
    TransportError,
)

__version__ = "0.1.0"

__all__ = [
    "CheckpointError",
    "ConfigError",
    "ProtocolError",
    "SemcastError",
    "SourceError",
    "TransportError",
    "__version__",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())
