"""Settings: frozen dataclasses filled from a TOML file first, then from command-line flags.

A settings class is a frozen, keyword-only dataclass whose fields carry ``metadata={"help": "..."}``. A field
may itself be such a dataclass: its fields become flags of the same command and a table in the TOML file.
"""

import argparse
import dataclasses
import difflib
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from semcast.common.errors import ConfigError

S = TypeVar("S")


def near_match(word: str, allowed: list[str]) -> str:
    """Return ``", did you mean 'x'?"`` for a close name in ``allowed``, or an empty string."""
    close = difflib.get_close_matches(word, allowed, n=1, cutoff=0.5)
    return f", did you mean {close[0]!r}?" if close else ""


def _plain_type(annotation: Any) -> tuple[Any, bool]:
    """Split ``X | None`` into ``(X, True)``; everything else is ``(annotation, False)``."""
    if get_origin(annotation) in (Union, types.UnionType):
        rest = [a for a in get_args(annotation) if a is not type(None)]
        if len(rest) == 1 and len(rest) < len(get_args(annotation)):
            return rest[0], True
    return annotation, False


def _nested(annotation: Any) -> type | None:
    plain, _ = _plain_type(annotation)
    return plain if isinstance(plain, type) and dataclasses.is_dataclass(plain) else None


def _annotations(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}


def _check(name: str, value: Any, annotation: Any) -> Any:
    """Convert a TOML or flag value to the annotated type, or say what was allowed."""
    plain, optional = _plain_type(annotation)
    if value is None and optional:
        return None
    origin = get_origin(plain)
    if origin is Literal:
        if value not in get_args(plain):
            allowed = ", ".join(str(a) for a in get_args(plain))
            hint = near_match(str(value), [str(a) for a in get_args(plain)])
            raise ConfigError(f"{name} must be one of {allowed}, got {value!r}{hint}")
        return value
    if origin is tuple:
        inner = get_args(plain)[0]
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{name} must be a list, got {value!r}")
        return tuple(_check(f"{name}[{k}]", item, inner) for k, item in enumerate(value))
    if plain is Path and isinstance(value, (str, Path)):
        return Path(value)
    if plain is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if plain in (int, bool, str) and type(value) is plain:
        return value
    wanted = getattr(plain, "__name__", str(plain))
    raise ConfigError(f"{name} must be of type {wanted}, got {value!r}")


def build_settings(cls: type[S], values: Mapping[str, Any], where: str = "") -> S:
    """Build a settings object from a mapping, nested mappings for nested settings.

    Raises:
        ConfigError: A key is unknown (with a near match), a value has the wrong type or is out of range.
    """
    annotations = _annotations(cls)
    resolved: dict[str, Any] = {}
    for key, value in values.items():
        if key not in annotations:
            hint = near_match(key, list(annotations))
            raise ConfigError(f"unknown setting {where + key!r}{hint}")
        nested = _nested(annotations[key])
        if nested is not None and isinstance(value, Mapping):
            resolved[key] = build_settings(nested, value, f"{where}{key}.")
        elif nested is not None and isinstance(value, nested):
            resolved[key] = value
        else:
            resolved[key] = _check(where + key, value, annotations[key])
    try:
        return cls(**resolved)
    except (TypeError, ValueError) as err:
        raise ConfigError(str(err)) from err


def read_toml(path: Path) -> dict[str, Any]:
    """Read a settings file.

    Raises:
        ConfigError: The file can't be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path} can't be read as settings: {err}") from err


def _flag_options(annotation: Any) -> dict[str, Any]:
    plain, _ = _plain_type(annotation)
    origin = get_origin(plain)
    if origin is Literal:
        return {"choices": get_args(plain), "type": type(get_args(plain)[0])}
    if origin is tuple:
        return {"nargs": "+", **_flag_options(get_args(plain)[0])}
    if plain is bool:
        return {"action": argparse.BooleanOptionalAction}
    return {"type": plain, "metavar": {int: "N", float: "X", Path: "PATH", str: "NAME"}.get(plain, "VALUE")}


def _default_text(field: "dataclasses.Field[Any]") -> str:
    default = field.default
    if default is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    if default is dataclasses.MISSING:
        return " (required)"
    if default is None or default == ():
        return ""
    if isinstance(default, tuple):
        default = " ".join(str(d) for d in default)
    return f" (default {default})"


def add_flags(
    parser: argparse.ArgumentParser, cls: type, skip: frozenset[str] = frozenset(), _prefix: str = ""
) -> None:
    """Add one flag per field, nested settings flattened; absent flags leave no value behind.

    A field with ``positional`` in its metadata is an argument without a flag.

    Args:
        parser: Where the flags go.
        cls: A settings class.
        skip: Dotted field names the command fills itself.
    """
    annotations = _annotations(cls)
    for field in dataclasses.fields(cls):
        dotted = _prefix + field.name
        if not field.init or dotted in skip:
            continue
        nested = _nested(annotations[field.name])
        if nested is not None:
            add_flags(parser, nested, skip, f"{dotted}.")
            continue
        text = str(field.metadata.get("help", "")).replace("%", "%%") + _default_text(field).replace(
            "%", "%%"
        )
        if field.metadata.get("positional"):
            # Optional for argparse, since a settings file may give it; a missing one is missed later.
            options = {
                "metavar": field.name.upper(),
                "nargs": "?",
                "type": _flag_options(annotations[field.name])["type"],
            }
            parser.add_argument(dotted, default=argparse.SUPPRESS, help=text, **options)
            continue
        parser.add_argument(
            "--" + field.metadata.get("flag", field.name).replace("_", "-"),
            dest=dotted,
            default=argparse.SUPPRESS,
            help=text,
            **_flag_options(annotations[field.name]),
        )


def settings_from(cls: type[S], arguments: argparse.Namespace, config: Path | None = None, **fixed: Any) -> S:
    """Merge defaults, a TOML file and flags, in this order, into a settings object.

    Args:
        cls: The settings class ``add_flags`` was called with.
        arguments: What ``parse_args`` returned; names that are no field of ``cls`` are left alone.
        config: A TOML file, or None.
        **fixed: Values the command itself sets.

    Raises:
        ConfigError: See ``build_settings`` and ``read_toml``.
    """
    values = read_toml(config) if config is not None else {}
    for dotted, value in vars(arguments).items():
        *tables, key = dotted.split(".")
        owner: type | None = cls
        for table in tables:
            owner = _nested(_annotations(owner)[table]) if owner and table in _annotations(owner) else None
        if owner is None or key not in _annotations(owner):
            continue
        target = values
        for table in tables:
            target = target.setdefault(table, {})
        target[key] = value
    values.update(fixed)
    return build_settings(cls, values)


def settings_to_dict(settings: Any) -> dict[str, Any]:
    """Return a settings object as plain JSON-ready values, nested settings as mappings."""
    result: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            result[field.name] = settings_to_dict(value)
        elif isinstance(value, Path):
            result[field.name] = str(value)
        else:
            result[field.name] = list(value) if isinstance(value, tuple) else value
    return result


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        return f'"{escaped}"'
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    return repr(value)


def to_toml(settings: Any) -> str:
    """Write a settings object as TOML that ``build_settings`` reads back; unset values are left out."""
    lines: list[str] = []

    def emit(values: Mapping[str, Any], table: str) -> None:
        if table:
            lines.append(f"\n[{table}]")
        lines.extend(
            f"{k} = {_toml_value(v)}" for k, v in values.items() if v is not None and not isinstance(v, dict)
        )
        for key, value in values.items():
            if isinstance(value, dict):
                emit(value, f"{table}.{key}" if table else key)

    emit(settings_to_dict(settings), "")
    return "\n".join(lines).lstrip("\n") + "\n"
