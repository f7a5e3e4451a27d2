"""What weights are: the manifest beside them, and where shipped ones lie. Needs no torch."""

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

from semcast.common.errors import CheckpointError
from semcast.common.whole_file import write_whole

#: Where shipped weights lie, with their manifests and the exported encoders of some.
SHIPPED_FOLDER = Path(__file__).resolve().parent.parent / "weights"
#: Raised when keys of the manifest change, or when the same weights mean another network (2: leaky units;
#: 3: told how well values arrive, not how they travel).
FORMAT = 3
_KINDS = {
    "architecture": str,
    "sizes": dict,
    "sha256": str,
    "cbr": float,
    "snr_range_db": list,
    "modulations": list,
    "made_by": dict,
    "measured": dict,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a file of weights is and how it came about.

    Attributes:
        format: Version of this manifest.
        architecture: Name in the registry.
        sizes: Sizes of the network.
        sha256: Of the weights file.
        cbr: Complex channel uses for each source value, pilots included.
        snr_range_db: SNR drawn in training.
        modulations: What the weights can be used with.
        made_by: Settings, data, steps, samples, wall time, seed, commit.
        measured: Quality on test images, with the command that measured it.
    """

    format: int = FORMAT
    architecture: str
    sizes: dict[str, Any]
    sha256: str
    cbr: float
    snr_range_db: tuple[float, float]
    modulations: tuple[str, ...]
    made_by: dict[str, Any]
    measured: dict[str, Any]


def manifest_path(weights: Path) -> Path:
    """Return the path of the manifest that belongs to a weights file."""
    return weights.with_suffix(".json")


def weights_path(name_or_path: str | Path) -> Path:
    """Return the weights file of a shipped name or of a path.

    Raises:
        CheckpointError: There is no such file, or it is an exported encoder.
    """
    path = Path(name_or_path)
    if path.suffix == ".safetensors":
        if not path.is_file():
            raise CheckpointError(f"weights {path} do not exist")
        return path
    if path.suffix == ".onnx":
        raise CheckpointError(
            f"{path} is an exported encoder, which can only send: give the .safetensors file it is of, "
            "or runtime onnx to an agent"
        )
    shipped = SHIPPED_FOLDER / f"{name_or_path}.safetensors"
    if not shipped.is_file():
        known = sorted(p.stem for p in SHIPPED_FOLDER.glob("*.safetensors"))
        if path.is_file():
            raise CheckpointError(f"weights must be a .safetensors file, got {path}")
        raise CheckpointError(
            f"no trained weights for {str(name_or_path)!r}; shipped are: {', '.join(known) or 'none'}"
        )
    return shipped


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file as 64 hex digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_manifest(weights: Path) -> Manifest:
    """Read and check the manifest of a weights file.

    Raises:
        CheckpointError: It is missing, damaged, of another format, or its sha256 is not that of the weights.
    """
    path = manifest_path(weights)
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise CheckpointError(f"manifest {path} can't be read: {err}") from err
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        seen = raw.get("format") if isinstance(raw, dict) else type(raw).__name__
        raise CheckpointError(f"manifest {path} must have format {FORMAT}, got {seen}")
    wanted = {f.name for f in dataclasses.fields(Manifest)}
    if set(raw) != wanted:
        raise CheckpointError(f"manifest {path} must have the keys {sorted(wanted)}, got {sorted(raw)}")
    for key, kind in _KINDS.items():
        if not isinstance(raw[key], kind):
            raise CheckpointError(f"{key} in manifest {path} must be {kind.__name__}, got {raw[key]!r:.80}")
    low_db, high_db = _snr_range_db(raw["snr_range_db"], path)
    manifest = Manifest(
        **{**raw, "snr_range_db": (low_db, high_db), "modulations": tuple(raw["modulations"])}
    )
    try:
        digest = file_sha256(weights)
    except OSError as err:
        raise CheckpointError(f"weights {weights} can't be read: {err}") from err
    if digest != manifest.sha256:
        raise CheckpointError(
            f"weights {weights} have sha256 {digest[:16]}, the manifest says {manifest.sha256[:16]}"
        )
    return manifest


def _snr_range_db(value: list[Any], path: Path) -> tuple[float, float]:
    try:
        low_db, high_db = (float(end) for end in value)
    except (TypeError, ValueError):
        low_db, high_db = math.nan, math.nan
    if not -math.inf < low_db <= high_db < math.inf:
        raise CheckpointError(f"snr_range_db in manifest {path} must be two ascending numbers, got {value}")
    return low_db, high_db


def write_manifest(manifest: Manifest, weights: Path) -> None:
    """Write the manifest beside its weights."""
    text = json.dumps(dataclasses.asdict(manifest), indent=1) + "\n"
    write_whole(manifest_path(weights), text)
