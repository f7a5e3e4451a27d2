"""The reference of all verbs and settings, from the parsers, and of all messages, from their classes."""

import argparse
import dataclasses
import inspect
import sys
import typing
from collections.abc import Iterator
from pathlib import Path

from semcast.cli import VERBS, verb_parser
from semcast.common.messages import Message
from semcast.evaluation.markdown import with_part

HEAD = """# Every verb and setting

Written by `make docs` from the command line itself; a test holds both together. Settings can also stand in
a TOML file given with `--config FILE`; flags win over it. Exit codes: 0 good, 1 an error said in one line,
2 wrong usage, 130 stopped by Ctrl-C.
"""


def _children(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _rows(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, (argparse._HelpAction, argparse._SubParsersAction)):
            continue
        names = ", ".join(f"`{name}`" for name in action.option_strings) or f"`{action.dest}`"
        text = (action.help or "").replace("%%", "%").replace("|", "\\|")
        if action.choices is not None:
            text += " - one of " + ", ".join(f"`{choice}`" for choice in action.choices)
        yield f"| {names} | {text} |"


def _section(level: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    yield f"\n{level} {parser.prog}\n\n{parser.description}\n"
    children = _children(parser)
    if not children:
        yield "| setting | what it does |\n|---|---|"
        yield from _rows(parser)
    for child in children.values():
        yield from _section(level + "#", child)


def reference() -> str:
    """Return the page as Markdown."""
    lines = [HEAD]
    for verb in VERBS:
        lines.extend(_section("##", verb_parser(verb)))
    return "\n".join(lines) + "\n"


def messages_table() -> str:
    """Return the table of all messages and their fields as Markdown."""
    lines = ["| kind | what | fields |", "|---|---|---|"]
    for cls in typing.get_args(Message):
        entries = {entry.name: entry for entry in dataclasses.fields(cls)}
        what = inspect.getdoc(cls) or ""
        names = ", ".join(f"`{name}`" for name in entries if name not in ("version", "kind"))
        lines.append(f"| `{entries['kind'].default}` | {what.splitlines()[0]} | {names} |")
    return "\n".join(lines)


def with_messages(page: str) -> str:
    """Put the table between the marks of a page.

    Raises:
        ValueError: A mark is missing.
    """
    return with_part(page, "messages", messages_table())


if __name__ == "__main__":
    formats = Path("docs/file-formats.md")
    if not formats.is_file():
        sys.exit(f"the pages are those of a checkout: there is no {formats} here; run this in its top folder")
    Path("docs/commands.md").write_text(reference(), encoding="utf-8")
    formats.write_text(with_messages(formats.read_text(encoding="utf-8")), encoding="utf-8")
