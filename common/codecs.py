"""All codecs by name, learned and conventional: the one way to get a codec."""

import logging
from collections.abc import Collection, Sequence
from functools import cache
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args

from semcast.common.codec import Codec, Device, Modulation, Precision, check_modulation
from semcast.common.config import near_match
from semcast.common.conventional_source import ImageFormat
from semcast.common.errors import CheckpointError, ConfigError

logger = logging.getLogger(__name__)

Runtime = Literal["auto", "torch", "onnx"]

_WEIGHTS_SUFFIXES = (".safetensors", ".onnx")
#: Learned transceivers in the order they are listed; their networks are in ``semcast.common.nets.registry``.
LEARNED_CODECS = ("3dcsc", "3dcsc-lite", "3dcsc-vr", "3dcsc-lite-vr", "cnn", "vit", "mae")


def _shipped_weights() -> list[str]:
    """Return the names of the weights that come with the package, known architectures first."""
    folder = resources.files("semcast.common.weights")
    suffix = ".safetensors"
    names = [item.name.removesuffix(suffix) for item in folder.iterdir() if item.name.endswith(suffix)]
    return sorted(names, key=lambda n: (LEARNED_CODECS.index(n) if n in LEARNED_CODECS else 99, n))


@cache
def _conventional_names() -> dict[str, tuple[ImageFormat, bool, bool]]:
    """Return name to (format, adaptive, slow) of what this OpenCV can do."""
    from semcast.common.conventional_source import supported

    formats: tuple[ImageFormat, ...] = get_args(ImageFormat)
    usable = [name for name in formats if supported(name)]
    names = {f"{name}-ldpc": (name, False, False) for name in usable}
    names |= {f"{name}-amc": (name, True, False) for name in usable}
    names |= {f"{name}-slow-amc": (name, True, True) for name in usable if name == "avif"}
    return names


def available_codecs() -> list[str]:
    """Return the codecs that can be used as installed, learned ones with weights first; loads no network."""
    return [*_shipped_weights(), *_conventional_names()]


def is_conventional(codec: str) -> bool:
    """Tell whether a codec of this name is made of an image format and a channel code."""
    return codec in _conventional_names()


def is_adaptive(codec: str) -> bool:
    """Tell whether a codec of this name chooses its modulation itself, by the SNR."""
    return is_conventional(codec) and _conventional_names()[codec][1]


def warn_of_modulation(codec: str | Sequence[str], given: Collection[str]) -> None:
    """Say that a modulation does nothing that was asked for.

    Args:
        codec: Name, or names: on one that is not adaptive it has an effect.
        given: Names of the settings that somebody gave.
    """
    names = [codec] if isinstance(codec, str) else list(codec)
    if "modulation" in given and names and all(map(is_adaptive, names)):
        logger.warning("modulation: no effect on codec %s, which chooses its own", ", ".join(names))


def _choose_runtime(runtime: Runtime, weights: Path | None) -> Literal["torch", "onnx"]:
    """Return torch where it is installed, unless the weights are an exported encoder."""
    if runtime != "auto":
        return runtime
    is_exported = weights is not None and weights.suffix == ".onnx"
    return "torch" if find_spec("torch") is not None and not is_exported else "onnx"


def _onnx_encoder(source: str | Path, modulation: Modulation, num_threads: int | None) -> Codec:
    if find_spec("onnxruntime") is None:
        raise ConfigError(
            "a learned codec needs torch (semcast[agent]) or, to send only, onnxruntime (semcast[edge]); "
            "neither was found"
        )
    from semcast.common.nets.onnx_encoder import OnnxEncoder

    return OnnxEncoder(source, modulation, num_threads)


def codec_of_weights(weights: Path, runtime: Runtime = "auto") -> str:
    """Return the name of the learned codec that weights belong to.

    Raises:
        ConfigError: The runtime is not installed.
        CheckpointError: The weights are missing or damaged, or a file of another kind.
    """
    is_named = weights.suffix in _WEIGHTS_SUFFIXES or str(weights) in _shipped_weights()
    if not is_named and weights.is_file():
        raise CheckpointError(f"weights must be a {' or '.join(_WEIGHTS_SUFFIXES)} file, got {weights}")
    if _choose_runtime(runtime, weights) == "onnx":
        return _onnx_encoder(weights, "16qam", 1).name
    from semcast.common.nets.manifest import read_manifest, weights_path

    return read_manifest(weights_path(weights)).architecture


def named_weights(codec: str, runtime: Runtime = "torch") -> tuple[str, Path | None]:
    """Return the name of a codec, and its weights where a weights file stands for it.

    Raises:
        ConfigError: The runtime is not installed.
        CheckpointError: The weights are missing or damaged.
    """
    if Path(codec).suffix not in _WEIGHTS_SUFFIXES:
        return codec, None
    return codec_of_weights(Path(codec), runtime), Path(codec)


def check_codec(codec: str) -> None:
    """Check that there is a codec of this name, or a weights file, without loading it.

    Raises:
        ConfigError: There is none.
    """
    names = available_codecs()
    if Path(codec).suffix in _WEIGHTS_SUFFIXES:
        if not Path(codec).is_file():
            raise ConfigError(f"codec must be a name or a file of weights, got {codec!r}: no such file")
    elif codec not in names:
        raise ConfigError(f"codec must be one of {', '.join(names)}, got {codec!r}{near_match(codec, names)}")


def _load_learned(
    source: str | Path,
    runtime: Literal["torch", "onnx"],
    modulation: Modulation,
    num_threads: int | None,
    device: Device,
    precision: Precision,
) -> Codec:
    if runtime == "onnx":
        if device == "cuda":
            raise ConfigError("device must be auto or cpu with the onnx runtime, got 'cuda'")
        if precision != "auto":
            raise ConfigError(
                f"precision must be auto with the onnx runtime, where the file decides, got {precision!r}"
            )
        return _onnx_encoder(source, modulation, num_threads)
    from semcast.common.nets.codec import NeuralCodec

    return NeuralCodec.load(
        source, modulation=modulation, num_threads=num_threads, device=device, precision=precision
    )


def load_codec(
    name: str,
    *,
    modulation: Modulation = "16qam",
    num_threads: int | None = None,
    device: Device = "auto",
    weights: Path | None = None,
    runtime: Runtime = "torch",
    precision: Precision = "auto",
) -> Codec:
    """Load a codec, ready for use.

    Args:
        name: One of ``available_codecs()``, a file of weights, or a learned architecture together with
            ``weights``.
        modulation: ``"16qam"`` or ``"analog"``.
        num_threads: CPU threads of a learned codec; None leaves the library's choice.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``, for learned codecs.
        weights: File to take instead of the shipped weights of a learned codec; it must be of that codec.
        runtime: What computes a learned codec: ``torch``; ``onnx``, which can only encode; ``auto``: torch
            where it is installed.
        precision: Of a learned codec on torch; see ``semcast.common.nets.precision``.

    What is asked of a network is warned of with a conventional codec, on which it has no effect.

    Raises:
        ConfigError: The name or modulation is unknown, weights were given for a codec without any or are
            another codec's, or the runtime, device or precision is not there.
        CheckpointError: The weights are missing or damaged.
    """
    check_modulation(modulation)
    if weights is None:
        name, weights = named_weights(name, runtime)
    if name in LEARNED_CODECS or name in _shipped_weights():
        source = name if weights is None else weights
        chosen = _choose_runtime(runtime, weights)
        codec = _load_learned(source, chosen, modulation, num_threads, device, precision)
        if weights is not None and codec.name != name:
            raise ConfigError(f"codec must be {codec.name!r}, that of the weights {weights}, got {name!r}")
        return codec
    conventional = _conventional_names()
    if name not in conventional:
        check_codec(name)
    if weights is not None:
        raise ConfigError(f"codec {name!r} has no weights, got {weights}")
    asked = {"device": device == "cuda", "runtime": runtime == "onnx", "precision": precision != "auto"}
    if idle := [setting for setting, is_asked in asked.items() if is_asked]:
        logger.warning("%s: no effect on codec %s, which has no network", ", ".join(idle), name)
    from semcast.common.conventional import ConventionalCodec

    image_format, adaptive, slow = conventional[name]
    return ConventionalCodec(image_format, adaptive=adaptive, slow=slow, modulation=modulation)
