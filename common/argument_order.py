"""Command lines in the order people write them: ``record --connect ENDPOINT FILE``.

A flag with several values takes all words up to the next flag, also a last one that was meant for the verb.
"""

import argparse
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

#: How a negative number begins, ``-1.8e-05`` too.
NEGATIVE = re.compile(r"-\.?\d")


class SeveralValues(argparse.Action):
    """A flag with one or more values.

    Args:
        option_strings: Names of the flag.
        dest: Where the values go.
        takes: Raises ``ValueError`` for a word that can't be one of the values.
        **options: As of any flag.
    """

    def __init__(
        self, option_strings: Sequence[str], dest: str, *, takes: Callable[[str], Any], **options: Any
    ) -> None:
        super().__init__(option_strings, dest, nargs="+", **options)
        self._takes = takes

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Keep the values."""
        setattr(namespace, self.dest, values)

    def can_take(self, word: str) -> bool:
        """Tell whether a word can be one of the values."""
        try:
            self._takes(word)
        except ValueError:
            return False
        return True


def arguments_last(parser: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """Move what follows the values of a flag, and can't be one, behind ``--``, where no flag takes it.

    Only a single word after at least one value is moved: more are mistakes, which the parser names better
    where they stand.
    """
    if all(action.option_strings for action in parser._actions):
        return list(words)
    end = words.index("--") if "--" in words else len(words)
    kept = list(words[:end])
    moved: list[str] = []
    flags = [k for k, word in enumerate(kept) if word.startswith("-") and not NEGATIVE.match(word)]
    for start, stop in reversed(list(pairwise([*flags, end]))):
        flag, values = parser._option_string_actions.get(kept[start]), kept[start + 1 : stop]
        if not isinstance(flag, SeveralValues) or len(values) < 2 or flag.can_take(values[-1]):
            continue
        if all(map(flag.can_take, values[:-1])):
            moved.insert(0, kept.pop(stop - 1))
    return [*kept, "--", *moved, *words[end + 1 :]] if moved else list(words)
