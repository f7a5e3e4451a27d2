"""What each field of a message may hold: the checks every value passes on its way to and from the wire."""

import math
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

#: Largest whole number that travels.
MAX_COUNT = 2**63 - 1


class FieldError(Exception):
    """A value is not what the field allows.

    Attributes:
        reason: ``type``, ``range`` or ``shape``.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True)
class WholeNumber:
    """An ``int`` in [low, high]."""

    low: int = 0
    high: int = MAX_COUNT

    def load(self, value: Any) -> int:
        """Return the value as received."""
        if type(value) is not int:
            raise FieldError("type", f"must be an integer, got {_short(value)}")
        if not self.low <= value <= self.high:
            raise FieldError("range", f"must be in [{self.low}, {self.high}], got {value}")
        return value

    dump = load


@dataclass(frozen=True)
class Number:
    """A finite ``float`` in [low, high]; a whole number is taken as well."""

    low: float = -math.inf
    high: float = math.inf

    def load(self, value: Any) -> float:
        """Return the value as received."""
        # NumPy's float64 is a float too; a bool is an int, but no number.
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FieldError("type", f"must be a number, got {_short(value)}")
        try:
            number = float(value)
        except OverflowError as err:
            raise FieldError("range", "must fit a float") from err
        if not math.isfinite(number) or not self.low <= number <= self.high:
            raise FieldError("range", f"must be finite and in [{self.low:g}, {self.high:g}], got {number:g}")
        return number

    dump = load


@dataclass(frozen=True)
class Flag:
    """A ``bool``."""

    def load(self, value: Any) -> bool:
        """Return the value as received."""
        if type(value) is not bool:
            raise FieldError("type", f"must be true or false, got {_short(value)}")
        return value

    dump = load


@dataclass(frozen=True)
class Text:
    """A ``str`` of at most ``max_chars``, matching ``pattern`` as a whole."""

    max_chars: int = 200
    pattern: str = ""

    def load(self, value: Any) -> str:
        """Return the value as received."""
        if type(value) is not str:
            raise FieldError("type", f"must be text, got {_short(value)}")
        if len(value) > self.max_chars:
            raise FieldError("range", f"must have at most {self.max_chars} characters, got {len(value)}")
        if self.pattern and re.fullmatch(self.pattern, value) is None:
            raise FieldError("range", f"must match {self.pattern}, got {value!r}")
        return value

    def dump(self, value: Any) -> str:
        """Check before sending; names of files may hold what is no text."""
        text = self.load(value)
        try:
            text.encode()
        except UnicodeEncodeError as err:
            raise FieldError("range", f"must be text that UTF-8 can hold, got {value!r}") from err
        return text


@dataclass(frozen=True)
class Choice:
    """One of some words."""

    words: tuple[str, ...]

    def load(self, value: Any) -> str:
        """Return the value as received."""
        if type(value) is not str:
            raise FieldError("type", f"must be text, got {_short(value)}")
        if value not in self.words:
            raise FieldError("range", f"must be one of {', '.join(self.words)}, got {value[:40]!r}")
        return value

    dump = load


@dataclass(frozen=True)
class Bytes:
    """``bytes`` of at most ``max_bytes``."""

    max_bytes: int

    def load(self, value: Any) -> bytes:
        """Return the value as received."""
        if type(value) is not bytes:
            raise FieldError("type", f"must be bytes, got {_short(value)}")
        if len(value) > self.max_bytes:
            raise FieldError("range", f"must have at most {self.max_bytes} bytes, got {len(value)}")
        return value

    dump = load


@dataclass(frozen=True)
class Many:
    """A tuple of ``item``, of exactly ``count`` elements or of at most ``at_most``."""

    item: Any
    count: int | None = None
    at_most: int = 1000

    def load(self, value: Any) -> tuple[Any, ...]:
        """Return a list from the wire as a tuple."""
        if type(value) not in (list, tuple):
            raise FieldError("type", f"must be a list, got {_short(value)}")
        if self.count is not None and len(value) != self.count:
            raise FieldError("shape", f"must have {self.count} elements, got {len(value)}")
        if len(value) > self.at_most:
            raise FieldError("shape", f"must have at most {self.at_most} elements, got {len(value)}")
        return tuple(self.item.load(item) for item in value)

    dump = load


@dataclass(frozen=True)
class Named:
    """A mapping from names to ``item``, at most ``at_most`` of them."""

    item: Any
    at_most: int = 200
    name: Text = field(default=Text(max_chars=100))

    def load(self, value: Any) -> dict[str, Any]:
        """Return the checked mapping."""
        if type(value) is not dict:
            raise FieldError("type", f"must be a mapping, got {_short(value)}")
        if len(value) > self.at_most:
            raise FieldError("shape", f"must have at most {self.at_most} entries, got {len(value)}")
        return {self.name.load(key): self.item.load(item) for key, item in value.items()}

    def dump(self, value: Any) -> dict[str, Any]:
        """Return what goes on the wire."""
        return {self.name.dump(key): self.item.dump(item) for key, item in self.load(value).items()}


_SETTING_TEXT = Text(max_chars=1000)


@dataclass(frozen=True)
class Setting:
    """A plain value of a control request: bool, int, float, text, or None."""

    def load(self, value: Any) -> Any:
        """Return the value as received."""
        if value is None or type(value) is bool:
            return value
        if type(value) is int:
            return WholeNumber(-(2**63)).load(value)
        return Number().load(value) if type(value) is float else _SETTING_TEXT.load(value)

    def dump(self, value: Any) -> Any:
        """Return what goes on the wire."""
        return _SETTING_TEXT.dump(value) if type(value) is str else self.load(value)


@dataclass(frozen=True)
class Maybe:
    """None or ``item``."""

    item: Any

    def load(self, value: Any) -> Any:
        """Return None, or the checked value."""
        return None if value is None else self.item.load(value)

    def dump(self, value: Any) -> Any:
        """Return None, or what goes on the wire."""
        return None if value is None else self.item.dump(value)


@dataclass(frozen=True)
class Array:
    """A finite array of one dtype, on the wire as ``[dtype, shape, little-endian bytes]``.

    Attributes:
        dtype: The only one accepted.
        shape: One entry per axis, None for a free one.
        max_items: Of all axes together.
    """

    dtype: str
    shape: tuple[int | None, ...]
    max_items: int = 1_000_000

    def load(self, value: Any) -> np.ndarray:
        """Return a read-only array over the received bytes; sizes are checked before it is made."""
        if type(value) not in (list, tuple) or len(value) != 3:
            raise FieldError("type", f"must be [dtype, shape, bytes], got {_short(value)}")
        dtype, shape, data = value
        if dtype != self.dtype:
            raise FieldError("type", f"must have dtype {self.dtype}, got {_short(dtype)}")
        if type(data) is not bytes or type(shape) not in (list, tuple):
            raise FieldError("type", f"must be [dtype, shape, bytes], got {_short(value)}")
        sizes = Many(WholeNumber(0, self.max_items), count=len(self.shape)).load(shape)
        self._check_sizes(sizes)
        if math.prod(sizes) * np.dtype(self.dtype).itemsize != len(data):
            raise FieldError("shape", f"shape {sizes} of {self.dtype} doesn't fit {len(data)} bytes")
        array = np.frombuffer(data, dtype=np.dtype(self.dtype).newbyteorder("<")).reshape(sizes)
        self._check_finite(array)
        return array

    def dump(self, value: Any) -> list[Any]:
        """Return what goes on the wire; the dtype must fit already."""
        if not isinstance(value, np.ndarray) or value.dtype != np.dtype(self.dtype):
            raise FieldError("type", f"must be an array of {self.dtype}, got {_short(value)}")
        if value.ndim != len(self.shape):
            raise FieldError("shape", f"must have {len(self.shape)} axes, got {value.shape}")
        self._check_sizes(value.shape)
        self._check_finite(value)
        data = np.ascontiguousarray(value).astype(np.dtype(self.dtype).newbyteorder("<"), copy=False)
        return [self.dtype, list(value.shape), data.tobytes()]

    def _check_sizes(self, sizes: tuple[int, ...]) -> None:
        for size, wanted in zip(sizes, self.shape, strict=True):
            if wanted is not None and size != wanted:
                raise FieldError("shape", f"must have shape {self.shape}, got {sizes}")
        if math.prod(sizes) > self.max_items:
            raise FieldError("shape", f"must have at most {self.max_items} items, got shape {sizes}")

    def _check_finite(self, array: np.ndarray) -> None:
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise FieldError("range", "must be finite")


def _short(value: Any) -> str:
    text = repr(value) if isinstance(value, (int, float, bool, str, type(None))) else type(value).__name__
    return text if len(text) <= 40 else text[:37] + "..."


def sendable(text: str, max_chars: int) -> str:
    """Return what may be sent of a text for people; names of files may hold what is no text."""
    return text[:max_chars].encode("utf-8", "replace").decode()


def rule(how: Any) -> dict[str, Any]:
    """Return dataclass field metadata that carries a check."""
    return {"wire": how}
