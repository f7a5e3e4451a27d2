"""Settings from the command line and a TOML file: defaults first, then the file, then flags.

Fields of nested settings become flags of the same command and a table in the file. The file may also name
them without the table, by their flag: ``snr_db = 4`` is ``[link]`` with ``snr_db = 4``.
"""

import argparse
import dataclasses
import operator
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from semcast.common.argument_order import NEGATIVE, SeveralValues
from semcast.common.config import (
    MissingSettingError,
    build_settings,
    check_values,
    fields_of,
    near_match,
    nested_settings,
    not_a_table,
    plain_type,
    read_toml,
    types_of,
    value_in,
)
from semcast.common.errors import ConfigError

S = TypeVar("S")


def _flag_options(annotation: Any, takes: Callable[[str], Any] | None = None) -> dict[str, Any]:
    plain, _ = plain_type(annotation)
    origin = get_origin(plain)
    if origin is Literal:
        return {"choices": get_args(plain), "type": type(get_args(plain)[0])}
    if origin is tuple:
        options = _flag_options(get_args(plain)[0])
        return {"action": SeveralValues, "takes": takes or options["type"], **options}
    if plain is bool:
        return {"action": argparse.BooleanOptionalAction}
    # A path stays text until it is checked: Path("") would be the working folder.
    return {
        "type": str if plain is Path else plain,
        "metavar": {int: "N", float: "X", Path: "PATH", str: "NAME"}.get(plain, "VALUE"),
    }


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
    annotations = types_of(cls)
    for field in fields_of(cls):
        dotted = prefix + field.name
        if dotted in skip:
            continue
        nested, default = nested_settings(annotations[field.name]), value_in(owner, field)
        if nested is not None:
            yield from _flags_of(nested, skip, f"{dotted}.", default)
        else:
            yield _Flag(dotted, field, annotations[field.name], default)


def add_flags(parser: argparse.ArgumentParser, cls: type, skip: frozenset[str] = frozenset()) -> None:
    """Add one flag per field, nested settings flattened; absent flags leave no value behind.

    A field with ``positional`` in its metadata is an argument without a flag; absent, it leaves None. One of
    several values may have ``takes``, which raises ``ValueError`` for a word that can't be one of them: so
    ``arguments_last`` tells values of a type that takes any word from the argument behind them.

    Args:
        parser: Where the flags go.
        cls: A settings class.
        skip: Dotted field names the command fills itself.
    """
    # That of older Pythons, 3.11 among them, takes a negative number with an exponent for a flag.
    parser._negative_number_matcher = NEGATIVE
    for flag in _flags_of(cls, skip):
        text = (str(flag.field.metadata.get("help", "")) + _default_text(flag.default)).replace("%", "%%")
        options = _flag_options(flag.annotation, flag.field.metadata.get("takes"))
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
            raise not_a_table(".".join(path[:depth]), values)
    return values


def _is_table(annotation: Any, value: Any) -> bool:
    """Whether a value in a file is a table of nested settings."""
    return isinstance(value, Mapping) and nested_settings(annotation) is not None


def _into_tables(cls: type, given: Mapping[str, Any], skip: frozenset[str]) -> dict[str, Any]:
    """Move what a file names by its flag into the table of the setting; the rest stays where it is.

    Raises:
        ConfigError: A name is neither a flag's nor a field's, or one setting has two values.
    """
    annotations = types_of(cls)
    flags = {flag.name: flag.dotted for flag in _flags_of(cls, skip)}
    values: dict[str, Any] = {}
    named_by_flag: dict[str, Any] = {}
    for key, value in given.items():
        if key in flags and not _is_table(annotations.get(key), value):
            named_by_flag[key] = value
        elif key in annotations:
            values[key] = value
        else:
            raise ConfigError(f"unknown setting {key!r}{near_match(key, [*flags, *annotations])}")
    for key, value in named_by_flag.items():
        *tables, name = flags[key].split(".")
        other = _table(values, tables).setdefault(name, value)
        if other is not value and other != value:  # NaN is not even equal to itself
            raise ConfigError(f"{key} and {flags[key]} are one setting, got {value!r} and {other!r}")
    return values


def _renamed(message: str, written: Mapping[str, str]) -> str:
    """Call a setting that a message begins with, or an entry of it, what the user has written."""
    found = re.match(r"[\w.]+", message)
    name = found.group() if found else ""
    return written.get(name, name) + message[len(name) :]


def _values_in(config: Path, cls: type, skip: frozenset[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the checked values of a settings file, and what it calls each: dotted name -> key.

    Raises:
        ConfigError: See ``given_values``; the message names the file, and settings as it does.
    """
    given, annotations = read_toml(config), types_of(cls)
    at_top = {key for key, value in given.items() if not _is_table(annotations.get(key), value)}
    flags = list(_flags_of(cls, skip))
    keys = {flag.dotted: flag.name for flag in flags if flag.name in at_top}
    try:
        values = check_values(cls, _into_tables(cls, given, skip))
    except ConfigError as err:
        raise ConfigError(f"{config}: {_renamed(str(err), keys)}") from err
    return values, {
        flag.dotted: keys.get(flag.dotted, flag.dotted) for flag in flags if _holds(values, flag.dotted)
    }


def _holds(values: Mapping[str, Any], dotted: str) -> bool:
    """Whether there is a value of this name in the tables of a file."""
    first, _, rest = dotted.partition(".")
    if not rest:
        return first in values
    return isinstance(table := values.get(first), Mapping) and _holds(table, rest)


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
    return _given(cls, arguments, config, skip)[0]


def _given(
    cls: type, arguments: argparse.Namespace, config: Path | None, skip: frozenset[str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what was given, see ``given_values``, and how the user has written it.

    The latter is by the name that a setting has in errors of ``build_settings``, its flag's without dashes.
    """
    values, keys = ({}, {}) if config is None else _values_in(config, cls, skip)
    written: dict[str, str] = {}
    shown: dict[str, str] = {}
    for flag in _flags_of(cls, skip):
        value = getattr(arguments, flag.dotted, None)
        if value is not None:
            *tables, key = flag.dotted.split(".")
            _table(values, tables)[key] = value
            written[flag.name] = shown[flag.dotted] = flag.shown
        elif flag.dotted in keys:
            written[flag.name] = f"{config}: {keys[flag.dotted]}"
    try:
        return check_values(cls, values), written
    except ConfigError as err:
        raise ConfigError(_renamed(str(err), shown)) from err


def settings_from(
    cls: type[S],
    arguments: argparse.Namespace,
    config: Path | None = None,
    skip: frozenset[str] = frozenset(),
) -> S:
    """Merge defaults, a TOML file and flags, in this order, into a settings object; see ``given_values``.

    Raises:
        ConfigError: See ``given_values`` and ``build_settings``; the error names the setting as it was given:
            its flag, or the file and the name it has there.
        MissingSettingError: A value without a default was not given; the error names its flag.
    """
    values, written = _given(cls, arguments, config, skip)
    try:
        return build_settings(cls, values)
    except MissingSettingError as err:
        shown = {flag.dotted: flag.shown for flag in _flags_of(cls, skip)}
        raise MissingSettingError(shown.get(err.name, err.name)) from err
    except ConfigError as err:
        raise ConfigError(_renamed(str(err), written)) from err


def flag_words(
    settings: object, always: Collection[str] = (), written: Callable[[Any], str] = str
) -> list[str]:
    """Return the words of a command line that ``settings_from`` makes the same settings of.

    Args:
        settings: Of a settings class; those at their defaults, and None, are left out.
        always: Dotted names of fields that are given all the same.
        written: Writes a value; by default as it is read.
    """
    words: list[str] = []
    for flag in _flags_of(type(settings), frozenset()):
        value = operator.attrgetter(flag.dotted)(settings)
        if value is None or (value == flag.default and flag.dotted not in always):
            continue
        if flag.is_positional:
            words.append(written(value))
        elif isinstance(value, bool):
            words.append(flag.shown if value else flag.shown.replace("--", "--no-", 1))
        else:
            words += [flag.shown, *map(written, value if isinstance(value, tuple) else (value,))]
    return words
