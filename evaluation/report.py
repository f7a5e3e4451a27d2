"""Results as JSON with their provenance: command, settings, seeds, versions, commit and kind of machine."""

import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from semcast.agent.video import public_name
from semcast.common.codec import Codec
from semcast.common.config_flags import flag_words
from semcast.common.cores import usable_cores
from semcast.common.errors import ConfigError, SemcastError
from semcast.common.source_commit import source_commit
from semcast.common.whole_file import check_writable
from semcast.evaluation.interruption import InterruptedMeasurementError, Part, is_part
from semcast.server.export.outputs import plain, versions_of, write_json

Settings = TypeVar("Settings")

#: File of a result in the folder its pictures go to.
RESULT_NAME = "result.json"
#: Folder of the results that pages are made of, where the source is.
RESULTS = Path("evaluation/results")
#: What ``--json`` is to have the result on stdout.
STDOUT = Path("-")
#: Libraries whose version can change a result.
LIBRARIES = ("numpy", "opencv-python-headless", "torch", "gtsam", "poselib")
#: Instruction sets that decide how fast a codec runs, widest last.
_CPU_FLAGS = (("avx2", "AVX2"), ("avx512f", "AVX512"), ("amx_tile", "AMX"))


def json_ready(value: Any) -> Any:
    """Return plain JSON values, see ``plain``.

    An absolute path is cut to its last part, so a result says which sequence it used and not where a
    machine keeps it.
    """
    return plain(value, lambda path: path.name if path.is_absolute() else str(path))


def check_outputs(json: Path | None, out: Path | None) -> None:
    """Refuse places that a result could not be written to, before the measurement.

    Args:
        json: File for the result; folders that lack are made.
        out: Folder for its pictures, made as well.

    Raises:
        ConfigError: Nothing can be written there.
    """
    try:
        if out is not None:
            if out.is_file():
                raise ConfigError(f"out must be a folder, {out} is a file")
            check_writable(out / RESULT_NAME, "out")
        if json is not None:
            check_writable(json, "json")
    except OSError as err:  # is_file and is_dir raise below a folder that may not be looked into
        raise ConfigError(f"{err.filename} can't be written: {err.strerror}") from err


def result_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files that match a pattern and hold whole results, not what an interruption left."""
    return [file for file in sorted(folder.glob(pattern)) if not is_part(file)]


class UnwrittenResultError(SemcastError):
    """A result that was measured and can't be written, as where the disk has become full meanwhile.

    Attributes:
        result: What was to be written.
    """

    def __init__(self, message: str, result: dict[str, Any]) -> None:
        super().__init__(message)
        self.result = result


def write_result(path: Path | None, result: Mapping[str, Any], part: Part | None = None) -> dict[str, Any]:
    """Return a result as plain JSON values, and write it where there is a path for it.

    The file is complete or absent, never half written.

    Args:
        path: File, or None.
        result: What was measured.
        part: Whether that is all. A part is marked as ``partial``, and its file ends in ``.partial.json``;
            the whole takes that one's place.

    Raises:
        UnwrittenResultError: The folder can't be made or the file can't be written.
        InterruptedMeasurementError: It is a part; raised when that is written.
    """
    is_cut = part is not None and part.is_cut
    values = {**({"partial": True} if is_cut else {}), **json_ready(result)}
    if path is not None and part is not None:
        path = part.name(path)
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, values)
            if part is not None and not is_cut:
                part.forget(path)
        except OSError as err:
            raise UnwrittenResultError(f"{path} can't be written: {err}", values) from err
    if is_cut:
        raise InterruptedMeasurementError(values, path)
    return values


def cpu_flags() -> set[str]:
    """Return what the processor can do, as Linux names it, among other words; empty on other systems."""
    try:
        return set(Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").split())
    except OSError:
        return set()


def machine_kind() -> str:
    """Return the kind of this machine, such as ``2-core x86-64, AVX2/AVX512/AMX``; never its name."""
    cores = usable_cores()
    architecture = {"x86_64": "x86-64", "AMD64": "x86-64"}.get(platform.machine(), platform.machine())
    flags = cpu_flags()
    sets = "/".join(name for flag, name in _CPU_FLAGS if flag in flags)
    return f"{cores}-core {architecture}" + (f", {sets}" if sets else "")


def command_line(verb: str, settings: Any) -> str:
    """Return the shell command that repeats a run: ``semcast <verb>`` with every setting off its default.

    Args:
        verb: Such as ``eval trajectory``.
        settings: A settings dataclass; paths and addresses are shown as ``provenance`` shows them.
    """
    words = flag_words(settings, written=lambda value: str(_public(json_ready(value))))
    return shlex.join(["semcast", *verb.split(), *words])


def _public(value: Any) -> Any:
    """Return a setting of plain values in which no text is an absolute path or has an address's password."""
    if isinstance(value, dict):
        return {name: _public(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_public(entry) for entry in value]
    if not isinstance(value, str):
        return value
    return json_ready(Path(value)) if Path(value).is_absolute() else public_name(value)


def naming(settings: Settings, used: Codec | Sequence[Codec] | None) -> Settings:
    """Return settings of a measurement that name the codecs used, where these were not loaded by name.

    Args:
        settings: With ``codec``, a name, and ``modulation``; or a tuple of names.
        used: A codec or several, as ``settings.codec`` has; None leaves the settings as they are.

    Raises:
        ValueError: Two of them have the same name.
    """
    if used is None:
        return settings
    if not isinstance(used, Sequence):
        return replace(settings, codec=used.name, modulation=used.modulation)  # type: ignore[type-var]
    return replace(settings, codec=tuple(codec.name for codec in used))  # type: ignore[type-var]


def short_names(names: Sequence[str]) -> list[str]:
    """Return codecs' names for tables and pictures: of a weights file what of its path tells it apart."""
    paths = [Path(name).parts for name in names]

    def short(path: tuple[str, ...]) -> str:
        tails = (path[-k:] for k in range(1, len(path)))
        alone = (tail for tail in tails if sum(other[-len(tail) :] == tail for other in paths) == 1)
        return str(Path(*next(alone, path)))

    return [short(path) for path in paths]


def provenance(verb: str, settings: Any) -> dict[str, Any]:
    """Return what a reader needs to repeat and place a result.

    Absolute paths are cut to their last part, also those that a setting has as text (a file of weights, a
    video), and addresses of network cameras are without their password.
    """
    return {
        "command": command_line(verb, settings),
        "settings": _public(json_ready(settings)),
        "commit": source_commit(),
        "machine": machine_kind(),
        "platform": sys.platform,
        "versions": versions_of(LIBRARIES),
    }
