"""The page of commands, from the parser of the command line."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator

from doc_links import linked

_HEAD = """# Commands

`evedrop COMMAND --help` prints the same for a command.
"""


def commands_page() -> str:
    """The page in Markdown: all commands by purpose, then a section for each with its example and its options."""
    os.environ["COLUMNS"] = "100"
    from evedrop.cli.main import parser_of  # noqa: PLC0415 - for its width

    parser = parser_of()
    commands = dict(_commands(parser))
    parts = [_HEAD, *_index(parser.sections, commands)]
    for name, command in commands.items():
        parts += [f"## {name}\n", *_section(command)]
    return "\n".join(parts)


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Name and parser of each command; a word that only begins the names of others is not one."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                inner = dict(_commands(command))
                yield from inner.items() if inner else [(command.prog.removeprefix("evedrop "), command)]


def _index(sections: dict[str, dict[str, str]], commands: dict[str, argparse.ArgumentParser]) -> Iterator[str]:
    yield "| to | command | |\n|---|---|---|"
    for section, names in sections.items():
        for number, (name, does) in enumerate(names.items()):
            link = f"[`{name}`](#{name.replace(' ', '-')})" if name in commands else f"`{name}`"
            yield f"| {'' if number else f'**{section}**'} | {link} | {_cell(does)} |"
    yield ""


def _section(command: argparse.ArgumentParser) -> Iterator[str]:
    """What the command does, how it is called, an example, the page about it, and its options, folded."""
    example = re.search(r"example:\n  (.+)", command.epilog or "")
    page = re.search(r"more: evedrop docs (\S+)", command.epilog or "")
    more = f" More: [{page[1]}](../{page[1]}.md)." if page else ""
    yield f"{_sentence(command.description or '')}{more}\n"
    usage = " ".join(command.format_usage().removeprefix("usage: ").split())
    yield f"```text\n{usage}\n{f'{example[1]}    # for example{chr(10)}' if example else ''}```\n"
    rows = [*_rows(command)]
    if rows:
        yield '??? note "Arguments and options"\n'
        yield from (f"    {row}" for row in ("| | |", "|---|---|", *rows))
        yield ""


def _rows(command: argparse.ArgumentParser) -> Iterator[str]:
    formatter = command._get_formatter()
    for action in command._actions:
        if action.help != argparse.SUPPRESS and not isinstance(action, argparse._HelpAction):
            name = formatter._format_action_invocation(action)
            yield f"| `{name}` | {_cell(_sentence(formatter._expand_help(action) if action.help else ''))} |"


def _sentence(text: str) -> str:
    """A text of the command line, in which pages are links."""
    return linked(text, "../")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")
