"""Weights on disk: half-precision safetensors, beside the manifest that says what they are."""

from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from semcast.common.errors import CheckpointError
from semcast.common.nets.manifest import Manifest, file_sha256, manifest_path, read_manifest, write_manifest
from semcast.common.nets.registry import build, sizes_to_dict
from semcast.common.nets.transceiver import Transceiver
from semcast.common.whole_file import write_whole

MAX_BYTES = 16 * 1024 * 1024


def load_transceiver(weights: Path) -> tuple[Transceiver, Manifest]:
    """Build the network a manifest describes and load its weights strictly.

    Raises:
        CheckpointError: Anything does not fit; the message says what.
    """
    manifest = read_manifest(weights)
    try:
        with torch.device("meta"):
            model = build(manifest.architecture, manifest.sizes)
    except (TypeError, ValueError, RuntimeError) as err:
        why = str(err).partition("\n")[0]
        raise CheckpointError(
            f"sizes in manifest {manifest_path(weights)} make no {manifest.architecture}: {why}"
        ) from err
    try:
        tensors = load_file(weights)
    except (OSError, SafetensorError) as err:
        raise CheckpointError(f"weights {weights} can't be read: {err}") from err
    wanted = model.state_dict()
    if set(tensors) != set(wanted):
        odd = sorted(set(tensors) ^ set(wanted))
        raise CheckpointError(
            f"weights {weights} do not fit {manifest.architecture}: {len(odd)} names differ, {odd[0]}"
        )
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape:
            raise CheckpointError(
                f"weights {weights} do not fit {manifest.architecture}: {name} must have shape "
                f"{tuple(wanted[name].shape)}, got {tuple(tensor.shape)}"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"weights {weights} are damaged: {name} is not finite")
    model.load_state_dict({k: v.float() for k, v in tensors.items()}, strict=True, assign=True)
    return model.eval(), manifest


def save_transceiver(
    model: Transceiver,
    weights: Path,
    *,
    architecture: str,
    sizes: Any,
    cbr: float,
    snr_range_db: tuple[float, float],
    made_by: dict[str, Any],
    measured: dict[str, Any] | None = None,
) -> Manifest:
    """Write weights in half precision and their manifest.

    Raises:
        CheckpointError: The file would be larger than ``MAX_BYTES``.
    """
    tensors = {k: v.detach().cpu().half().contiguous() for k, v in model.state_dict().items()}
    num_bytes = sum(t.numel() * t.element_size() for t in tensors.values())
    if num_bytes > MAX_BYTES:
        raise CheckpointError(f"weights must be <= {MAX_BYTES} bytes, got {num_bytes}")
    weights.parent.mkdir(parents=True, exist_ok=True)
    write_whole(weights, save(tensors))
    manifest = Manifest(
        architecture=architecture,
        sizes=sizes_to_dict(sizes),
        sha256=file_sha256(weights),
        cbr=cbr,
        snr_range_db=snr_range_db,
        modulations=("16qam", "analog"),
        made_by=made_by,
        measured=measured or {},
    )
    write_manifest(manifest, weights)
    return manifest
