"""Messages to bytes and back: msgpack maps, checked field by field before anything is built from them."""

from dataclasses import MISSING, fields
from typing import Any, TypeVar, get_args

import msgpack

from semcast.common.errors import ProtocolError
from semcast.common.message_fields import FieldError
from semcast.common.messages import PROTOCOL_VERSION, Message

#: A payload of 16 MiB is the largest single field; a map of 300 000 landmarks has 9 MB.
MAX_MESSAGE_BYTES = 32 * 1024**2
_MAX_ITEMS = 4096
#: Lists and maps in one message, nested ones too; ours have a few, and one for each dictionary of a status.
_MAX_CONTAINERS = 1000

M = TypeVar("M")


class WireError(ProtocolError):
    """Bytes are not a valid message, or a message holds what may not be sent.

    Attributes:
        reason: ``size``, ``syntax``, ``version``, ``kind``, ``missing``, ``unknown``, ``type``, ``range`` or
            ``shape``: what counters and tests go by.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def _kind_of(cls: Any) -> str:
    return str(next(f.default for f in fields(cls) if f.name == "kind"))


_CLASSES: dict[str, Any] = {_kind_of(cls): cls for cls in get_args(Message)}
_RULES: dict[str, list[tuple[str, Any, bool]]] = {
    kind: [
        (f.name, f.metadata["wire"], f.default is MISSING and f.default_factory is MISSING)
        for f in fields(cls)
    ]
    for kind, cls in _CLASSES.items()
}


def pack(message: Message) -> bytes:
    """Serialise a message, version and kind first.

    Raises:
        WireError: A field holds what the receiver would refuse, or the message is too large.
    """
    kind = message.kind
    values: dict[str, Any] = {}
    name = ""
    try:
        for name, how, _ in _RULES[kind]:
            values[name] = how.dump(getattr(message, name))
        name = "message"
        if hasattr(message, "consistent"):
            message.consistent()
    except FieldError as err:
        raise WireError(err.reason, f"{kind}.{name} {err}") from err
    data = bytes(msgpack.packb(values, use_bin_type=True))
    _check_size(data)
    return data


def unpack(data: bytes, expected: type[M]) -> M:
    """Read a message of one kind.

    Args:
        data: From the network; anything may be in it.
        expected: The message class that belongs on the key.

    Raises:
        WireError: The bytes are not such a message. No more memory than their own size was allocated, or a
            few hundred kilobytes.
    """
    wanted = _kind_of(expected)
    try:
        _check_size(data)
        values = _parse(data)
    except WireError as err:
        raise WireError(err.reason, f"{wanted}: {err}") from err
    version = values.get("version")
    if type(version) is not int or version != PROTOCOL_VERSION:
        text = (
            f"{wanted}: protocol version must be {PROTOCOL_VERSION}, got {str(version)[:20]}: install the "
            "same version of semcast on both ends"
        )
        raise WireError("version", text)
    kind = values.get("kind")
    if type(kind) is not str or kind != wanted:
        raise WireError("kind", f"kind must be {wanted!r}, got {str(kind)[:40]!r}")
    rules = _RULES[wanted]
    unknown = values.keys() - {name for name, _, _ in rules}
    if unknown:
        raise WireError("unknown", f"{wanted} has no field {sorted(unknown)[0][:40]!r}")
    loaded: dict[str, Any] = {}
    for name, how, required in rules:
        if name not in values:
            if required:
                raise WireError("missing", f"{wanted}.{name} is missing")
            continue
        try:
            loaded[name] = how.load(values[name])
        except FieldError as err:
            raise WireError(err.reason, f"{wanted}.{name} {err}") from err
    message = expected(**loaded)
    try:
        if hasattr(message, "consistent"):
            message.consistent()
    except FieldError as err:
        raise WireError(err.reason, f"{wanted}: {err}") from err
    return message


def _check_size(data: bytes) -> None:
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError("size", f"message must have at most {MAX_MESSAGE_BYTES} bytes, got {len(data)}")


def _parse(data: bytes) -> dict[str, Any]:
    num_containers = 0

    def count(container: Any) -> Any:
        """Stop at once where lists and maps, which cost more than their bytes, are too many."""
        nonlocal num_containers
        num_containers += 1
        if num_containers > _MAX_CONTAINERS:
            raise ValueError(f"more than {_MAX_CONTAINERS} lists and maps")
        return container

    try:
        values = msgpack.unpackb(
            data,
            list_hook=count,
            object_hook=count,
            raw=False,
            strict_map_key=True,
            max_str_len=_MAX_ITEMS,
            max_bin_len=MAX_MESSAGE_BYTES,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as err:
        raise WireError("syntax", f"bytes are not a message: {str(err)[:100] or type(err).__name__}") from err
    if type(values) is not dict or not all(type(key) is str for key in values):
        raise WireError("syntax", f"message must be a map with text keys, got {type(values).__name__}")
    return values
