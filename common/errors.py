"""Errors a user can act on. Wrong arguments inside the code stay ``ValueError`` / ``TypeError``."""


class SemcastError(Exception):
    """Root of all errors shown to the user as one line."""


class ConfigError(SemcastError):
    """A setting is unknown, of the wrong type or out of range."""


class ProtocolError(SemcastError):
    """Bytes from the network are not a valid message."""


class TransportError(SemcastError):
    """A Zenoh session could not be opened or a peer did not answer in time."""


class CheckpointError(SemcastError):
    """Weights or a saved map are missing, damaged or made for something else."""


class SourceError(SemcastError):
    """Images, calibration or ground truth could not be read."""


def tell_nobody(text: str) -> None:
    """Take a line about what went wrong where nobody is to be told of it."""
