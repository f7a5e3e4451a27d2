"""Settings: frozen dataclasses filled from a TOML file first, then from command-line flags.

A settings class is a frozen, keyword-only dataclass whose fields carry ``metadata={"help": "..."}``. A field
may itself be such a dataclass: its fields become flags of the same command and a table in the TOML file. The
file may also name them without the table, by their flag: ``snr_db = 4`` is ``[link]`` with ``snr_db = 4``.
"""

import argparse
import dataclasses
import difflib
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
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


def _fields(cls: type) -> list["dataclasses.Field[Any]"]:
    return [field for field in dataclasses.fields(cls) if field.init]


def _annotations(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in _fields(cls)}


def _no_table(name: str, value: Any) -> ConfigError:
    return ConfigError(f"{name} must be a table of settings, got {value!r}")


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
    if _nested(plain) is not None:
        if isinstance(value, plain):
            return value
        raise _no_table(name, value)
    wanted = getattr(plain, "__name__", str(plain))
    raise ConfigError(f"{name} must be of type {wanted}, got {value!r}")


def check_values(cls: type, values: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return the values in the types of the settings; nested settings stay mappings, ranges stay unchecked.

    Raises:
        ConfigError: A key is unknown (with a near match) or a value has the wrong type.
    """
    annotations = _annotations(cls)
    checked: dict[str, Any] = {}
    for key, value in values.items():
        if key not in annotations:
            hint = near_match(key, list(annotations))
            raise ConfigError(f"unknown setting {where + key!r}{hint}")
        nested = _nested(annotations[key])
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


def _value_in(owner: Any, field: "dataclasses.Field[Any]") -> Any:
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
    annotations = _annotations(cls)
    resolved: dict[str, Any] = {}
    for field in _fields(cls):
        nested = _nested(annotations[field.name])
        fallback = _value_in(default, field)
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


def _default_text(default: Any) -> str:
    if default is dataclasses.MISSING:
        return " (required)"
    if default is None or default == ():
        return ""
    if isinstance(default, tuple):
        default = " ".join(str(d) for d in default)
    return f" (default {default})"


@dataclasses.dataclass(frozen=True)
class _Flag:
    """A setting as the command line takes it."""

    dotted: str
    field: "dataclasses.Field[Any]"
    annotation: Any
    default: Any

    @property
    def is_positional(self) -> bool:
        return bool(self.field.metadata.get("positional"))

    @property
    def name(self) -> str:
        """What a settings file may call it at its top level."""
        return str(self.field.metadata.get("flag", self.field.name))

    @property
    def shown(self) -> str:
        """What a user types: ``--expect-snr-db``, or ``FILE`` for an argument without a flag."""
        return self.name.upper() if self.is_positional else "--" + self.name.replace("_", "-")


def _flags_of(
    cls: type, skip: frozenset[str], prefix: str = "", owner: Any = dataclasses.MISSING
) -> Iterator[_Flag]:
    """Yield every setting the command line takes; ``owner`` holds the defaults of a nested class."""
    annotations = _annotations(cls)
    for field in _fields(cls):
        dotted = prefix + field.name
        if dotted in skip:
            continue
        nested, default = _nested(annotations[field.name]), _value_in(owner, field)
        if nested is not None:
            yield from _flags_of(nested, skip, f"{dotted}.", default)
        else:
            yield _Flag(dotted, field, annotations[field.name], default)


def add_flags(parser: argparse.ArgumentParser, cls: type, skip: frozenset[str] = frozenset()) -> None:
    """Add one flag per field, nested settings flattened; absent flags leave no value behind.

    A field with ``positional`` in its metadata is an argument without a flag; absent, it leaves None.

    Args:
        parser: Where the flags go.
        cls: A settings class.
        skip: Dotted field names the command fills itself.
    """
    for flag in _flags_of(cls, skip):
        text = (str(flag.field.metadata.get("help", "")) + _default_text(flag.default)).replace("%", "%%")
        options = _flag_options(flag.annotation)
        if flag.is_positional:
            # Optional for argparse, since a settings file may give it; a missing one is missed later. Python
            # 3.11 would turn SUPPRESS, a string, into a value of the argument's type.
            options = {"nargs": "?", "metavar": flag.shown, "type": options["type"]}
            parser.add_argument(flag.dotted, default=None, help=text, **options)
        else:
            parser.add_argument(flag.shown, dest=flag.dotted, default=argparse.SUPPRESS, help=text, **options)


def _table(values: dict[str, Any], path: Sequence[str]) -> dict[str, Any]:
    """Return the table at a path, made where it is missing.

    Raises:
        ConfigError: A plain value stands there.
    """
    for depth, name in enumerate(path, start=1):
        values = values.setdefault(name, {})
        if not isinstance(values, dict):
            raise _no_table(".".join(path[:depth]), values)
    return values


def _into_tables(cls: type, given: Mapping[str, Any], skip: frozenset[str]) -> dict[str, Any]:
    """Move what a file names by its flag into the table of the setting; the rest stays where it is.

    Raises:
        ConfigError: A name is neither a flag's nor a field's, or one setting has two values.
    """
    annotations = _annotations(cls)
    flags = {flag.name: flag.dotted for flag in _flags_of(cls, skip)}
    values: dict[str, Any] = {}
    named_by_flag: dict[str, Any] = {}
    for key, value in given.items():
        is_table = isinstance(value, Mapping) and _nested(annotations.get(key)) is not None
        if key in flags and not is_table:
            named_by_flag[key] = value
        elif key in annotations:
            values[key] = value
        else:
            raise ConfigError(f"unknown setting {key!r}{near_match(key, [*flags, *annotations])}")
    for key, value in named_by_flag.items():
        *tables, name = flags[key].split(".")
        other = _table(values, tables).setdefault(name, value)
        if other != value:
            raise ConfigError(f"{key} and {flags[key]} are one setting, got {value!r} and {other!r}")
    return values


def given_values(
    cls: type, arguments: argparse.Namespace, config: Path | None = None, skip: frozenset[str] = frozenset()
) -> dict[str, Any]:
    """Merge a TOML file and flags, which win, into the values that were given; defaults are left out.

    Args:
        cls: The settings class ``add_flags`` was called with.
        arguments: What ``parse_args`` returned; names that are no flag of ``cls`` are left alone.
        config: A TOML file, or None. It may give a setting in its table, by its flag's name at the top level,
            or both ways with the same value.
        skip: As given to ``add_flags``.

    Returns:
        Checked values as ``build_settings`` takes them, those of nested settings in mappings.

    Raises:
        ConfigError: See ``check_values`` and ``read_toml``; or a file gives one setting two values.
    """
    values = {} if config is None else _into_tables(cls, read_toml(config), skip)
    for flag in _flags_of(cls, skip):
        value = getattr(arguments, flag.dotted, None)
        if value is not None:
            *tables, key = flag.dotted.split(".")
            _table(values, tables)[key] = value
    return check_values(cls, values)


def settings_from(
    cls: type[S],
    arguments: argparse.Namespace,
    config: Path | None = None,
    skip: frozenset[str] = frozenset(),
) -> S:
    """Merge defaults, a TOML file and flags, in this order, into a settings object; see ``given_values``.

    Raises:
        ConfigError: See ``given_values`` and ``build_settings``.
        MissingSettingError: A value without a default was not given; the error names its flag.
    """
    try:
        return build_settings(cls, given_values(cls, arguments, config, skip))
    except MissingSettingError as err:
        shown = {flag.dotted: flag.shown for flag in _flags_of(cls, skip)}
        raise MissingSettingError(shown.get(err.name, err.name)) from err


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
