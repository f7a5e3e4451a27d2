"""Architectures by name. A checkpoint's manifest says the sizes; a name alone gives the published ones."""

import dataclasses
from collections.abc import Callable
from typing import Any

from semcast.common.config import near_match
from semcast.common.errors import CheckpointError
from semcast.common.nets.cnn import CnnSizes, build_cnn
from semcast.common.nets.mae import build_mae
from semcast.common.nets.transceiver import Sizes, Transceiver, build_3dcsc, build_variable_3dcsc
from semcast.common.nets.vit import VitSizes, build_vit


@dataclasses.dataclass(frozen=True)
class Architecture:
    """One entry of the registry.

    Attributes:
        name: What ``--codec`` and the manifest call it.
        sizes: A frozen dataclass of sizes with the published values.
        build: Makes an untrained network from such sizes.
    """

    name: str
    sizes: Any
    build: Callable[[Any], Transceiver]


def _entries() -> tuple[Architecture, ...]:
    main = Sizes((96, 160, 192), (1, 2, 3), (1, 2, 3), 48)
    lite = Sizes((64, 96, 160), (1, 1, 2), (1, 2, 3), 32)
    # With its longer latent the whole of the main network would not fit into the 16 MB of a weights file; of
    # its units the first of the encoder at 1/16 did least.
    main_variable = Sizes((96, 160, 192), (1, 2, 2), (1, 2, 3), 48)
    return (
        Architecture("3dcsc", main, build_3dcsc),
        Architecture("3dcsc-lite", lite, build_3dcsc),
        Architecture("3dcsc-vr", main_variable, build_variable_3dcsc),
        Architecture("3dcsc-lite-vr", lite, build_variable_3dcsc),
        Architecture("cnn", CnnSizes(), build_cnn),
        Architecture("vit", VitSizes(), build_vit),
        Architecture("mae", VitSizes(), build_mae),
    )


def architectures() -> dict[str, Architecture]:
    """Return all architectures by name.

    Raises:
        ValueError: Two entries have one name.
    """
    known: dict[str, Architecture] = {}
    for entry in _entries():
        if entry.name in known:
            raise ValueError(f"architecture {entry.name!r} is registered twice")
        known[entry.name] = entry
    return known


def architecture(name: str) -> Architecture:
    """Return one architecture.

    Raises:
        CheckpointError: The name is unknown; the message lists those known.
    """
    known = architectures()
    if name not in known:
        hint = near_match(name, list(known))
        raise CheckpointError(f"architecture must be one of {', '.join(known)}, got {name!r}{hint}")
    return known[name]


def sizes_to_dict(sizes: Any) -> dict[str, Any]:
    """Return sizes as plain JSON values."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(sizes).items()}


def build(name: str, sizes: dict[str, Any] | None = None) -> Transceiver:
    """Build an untrained transceiver.

    Args:
        name: Of the architecture.
        sizes: From a manifest; None for the published ones.

    Raises:
        CheckpointError: The name or a size is unknown, or one is missing.
    """
    entry = architecture(name)
    if sizes is None:
        return entry.build(entry.sizes)
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()}
    wanted = {f.name for f in dataclasses.fields(entry.sizes)}
    if set(values) != wanted:
        raise CheckpointError(f"sizes of {name} must be {sorted(wanted)}, got {sorted(values)}")
    return entry.build(type(entry.sizes)(**values))
