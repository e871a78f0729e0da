"""The page of commands, from the parser of the command line."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator

_HEAD = """# Commands

The help of every command, as `evedrop COMMAND --help` prints it.
"""


def commands_page() -> str:
    """The page in Markdown: the help of all, and a section for each command."""
    os.environ["COLUMNS"] = "100"
    from evedrop.cli.main import parser_of  # noqa: PLC0415 - for its width

    parser = parser_of()
    parts = [_HEAD, _block(parser)]
    for command in _commands(parser):
        parts += [f"## {command.prog}\n", _block(command)]
    return "\n".join(parts)


def _commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield command
                yield from _commands(command)


def _block(parser: argparse.ArgumentParser) -> str:
    return f"```text\n{parser.format_help()}```\n"
