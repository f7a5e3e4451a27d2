"""Settings: frozen dataclasses, built from checked values and written as TOML.

A settings class is a frozen, keyword-only dataclass whose fields carry ``metadata={"help": "..."}``. A field
may itself be such a dataclass: a table in the TOML file.
"""

import dataclasses
import difflib
import json
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from semcast.common.errors import ConfigError

S = TypeVar("S")


class MissingSettingError(ConfigError):
    """A setting without a default was not given: wrong usage of a command.

    Attributes:
        name: Dotted name of the setting, or what the command line calls it.
    """

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} is required")
        self.name = name


def near_match(word: str, allowed: list[str]) -> str:
    """Return ``", did you mean 'x'?"`` for a close name in ``allowed``, or an empty string."""
    # "snr" is close to "snr_db" (0.67), and "resize" to "trace_file" (0.5) is not. A word cut short
    # is one that begins so: "seq" is closer to "seed" than to "sequence".
    begun = [name for name in allowed if word and name.startswith(word)]
    close = difflib.get_close_matches(word, begun or allowed, n=1, cutoff=0.0 if begun else 0.65)
    return f", did you mean {close[0]!r}?" if close else ""


def plain_type(annotation: Any) -> tuple[Any, bool]:
    """Split ``X | None`` into ``(X, True)``; everything else is ``(annotation, False)``."""
    if get_origin(annotation) in (Union, types.UnionType):
        rest = [a for a in get_args(annotation) if a is not type(None)]
        if len(rest) == 1 and len(rest) < len(get_args(annotation)):
            return rest[0], True
    return annotation, False


def nested_settings(annotation: Any) -> type | None:
    """Return the settings class a field holds, None for a plain value."""
    plain, _ = plain_type(annotation)
    return plain if isinstance(plain, type) and dataclasses.is_dataclass(plain) else None


def fields_of(cls: type) -> list["dataclasses.Field[Any]"]:
    """Return the fields that can be set."""
    return [field for field in dataclasses.fields(cls) if field.init]


def types_of(cls: type) -> dict[str, Any]:
    """Return the annotation of each field that can be set, resolved."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in fields_of(cls)}


def not_a_table(name: str, value: Any) -> ConfigError:
    """Return the error of a plain value where nested settings stand."""
    return ConfigError(f"{name} must be a table of settings, got {value!r}")


def _check(name: str, value: Any, annotation: Any) -> Any:
    """Convert a TOML or flag value to the annotated type, or say what was allowed."""
    plain, optional = plain_type(annotation)
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
        # A NUL has an error of its own kind wherever it is opened; Path("") would be the working folder.
        if value == "" or "\0" in str(value):
            raise ConfigError(f"{name} must be the name of a file or folder, got {value!r}")
        return Path(value)
    if plain is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError as err:
            raise ConfigError(f"{name} must fit a float, got a larger number") from err
    if plain in (int, bool, str) and type(value) is plain:
        return value
    if nested_settings(plain) is not None:
        if isinstance(value, plain):
            return value
        raise not_a_table(name, value)
    wanted = getattr(plain, "__name__", str(plain))
    raise ConfigError(f"{name} must be of type {wanted}, got {value!r}")


def check_values(cls: type, values: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return the values in the types of the settings; nested settings stay mappings, ranges stay unchecked.

    Raises:
        ConfigError: A key is unknown (with a near match) or a value has the wrong type.
    """
    annotations = types_of(cls)
    checked: dict[str, Any] = {}
    for key, value in values.items():
        if key not in annotations:
            hint = near_match(key, list(annotations))
            raise ConfigError(f"unknown setting {where + key!r}{hint}")
        nested = nested_settings(annotations[key])
        if nested is not None and isinstance(value, Mapping):
            checked[key] = check_values(nested, value, f"{where}{key}.")
        else:
            checked[key] = _check(where + key, value, annotations[key])
    return checked


def _default_of(field: "dataclasses.Field[Any]") -> Any:
    """Return the default of a field, ``dataclasses.MISSING`` where there is none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def value_in(owner: Any, field: "dataclasses.Field[Any]") -> Any:
    """Return a field's value in ``owner``, an object of its class, or its default where there is no owner."""
    return _default_of(field) if owner is dataclasses.MISSING else getattr(owner, field.name)


def build_settings(cls: type[S], values: Mapping[str, Any]) -> S:
    """Build a settings object from a mapping, nested mappings for nested settings.

    Raises:
        ConfigError: A key is unknown (with a near match), a value has the wrong type or is out of range.
        MissingSettingError: A value without a default is missing.
    """
    return _construct(cls, check_values(cls, values))


def _construct(
    cls: type[S], checked: Mapping[str, Any], where: str = "", default: Any = dataclasses.MISSING
) -> S:
    """Build settings from checked values; what was not given is taken from ``default``, if there is one."""
    annotations = types_of(cls)
    resolved: dict[str, Any] = {}
    for field in fields_of(cls):
        nested = nested_settings(annotations[field.name])
        fallback = value_in(default, field)
        value = checked.get(field.name, fallback)
        if value is dataclasses.MISSING:
            if nested is None:
                raise MissingSettingError(where + field.name)
            value = {}
        if nested is not None and isinstance(value, Mapping):
            value = _construct(nested, value, f"{where}{field.name}.", fallback)
        resolved[field.name] = value
    try:
        return cls(**resolved)
    except (TypeError, ValueError) as err:
        raise ConfigError(_named_as_given(cls, str(err))) from err


def _named_as_given(cls: type, message: str) -> str:
    """Call a setting that a message begins with what the command line and settings files call it."""
    first, space, rest = message.partition(" ")
    flags = {field.name: str(field.metadata.get("flag", field.name)) for field in fields_of(cls)}
    return flags.get(first, first) + space + rest


def read_toml(path: Path) -> dict[str, Any]:
    """Read a settings file.

    Raises:
        ConfigError: The file can't be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as err:  # bad TOML, no text, endless numbers or nesting
        raise ConfigError(f"{path} can't be read as settings: {err}") from err


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
        # Names of files may hold bytes that are no text, and control characters, which JSON writes like TOML.
        text = value.encode("utf-8", "replace").decode()
        return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    return repr(value)


def to_toml(settings: Any) -> str:
    """Write a settings object as TOML that ``build_settings`` reads back; unset values are left out.

    What is no text in the name of a file becomes a question mark.
    """
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


def check_at_least(settings: object, **least: int) -> None:
    """Check the least value of some settings; of one that is None there is nothing to check.

    Args:
        settings: Whose fields they are.
        **least: Names, and the least value of each.

    Raises:
        ValueError: One is less.
    """
    for name, low in least.items():
        value = getattr(settings, name)
        if value is not None and value < low:
            raise ValueError(f"{name} must be at least {low}, got {value}")
