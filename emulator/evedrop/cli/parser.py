"""The parser of the command line: argparse, with a hint for a mistyped word, no abbreviations, and help in sections.

It uses two private names of argparse. If a later Python lacks `_option_string_actions`, options have no hints; if it lacks
`_negative_number_matcher`, a list that begins with a minus must be given as `--reference=-1,2`.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from typing import TYPE_CHECKING, Any, NoReturn

from evedrop.system.hints import near

if TYPE_CHECKING:
    from argparse import _SubParsersAction


_LEAST = 20  # columns for a description; on a narrower terminal it is below its name


def name_lines(described: Mapping[str, str], width: int, columns: int) -> Iterator[str]:
    """The lines of the two columns; width: of the first one; columns: of the terminal."""
    below = columns - width < _LEAST
    for name, description in described.items():
        lines = textwrap.wrap(description, max(1, columns - (4 if below else width))) or [""]
        first = "" if below else lines.pop(0)
        yield f"{name:<{width}}{first}".rstrip()
        yield from (" " * (4 if below else width) + line for line in lines)


def print_names(described: Mapping[str, str]) -> None:
    """Print names with their descriptions; one in a line if standard output is not a terminal."""
    on_terminal = sys.stdout.isatty()
    columns = shutil.get_terminal_size().columns if on_terminal else sys.maxsize
    for line in name_lines(described, max(map(len, described)) + 2, columns):
        print(line)


_WIDEST = 100
_NARROWEST = 30


def _columns() -> int:
    """The width of help: that of the terminal, within limits. Unlike argparse's own, at least 30."""
    return max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size().columns - 2))


class _Help(argparse.RawDescriptionHelpFormatter):
    """Formats help within the width, and breaks an example so that a shell can still read it."""

    def __init__(self, prog: str, **more: Any) -> None:
        """more: what a later Python may add."""
        super().__init__(prog, **{**more, "width": _columns()})

    def add_usage(
        self,
        usage: str | None,
        actions: Iterable[argparse.Action],
        groups: Iterable[Any],
        prefix: str | None = None,
    ) -> None:
        """The usage without optional arguments, which are listed below it."""
        if usage is None and prefix is None:
            options = argparse.Action([], "options", metavar="[options]")
            usage = _usage(
                self._prog, [options, *(action for action in actions if action.required or not action.option_strings)]
            )
        super().add_usage(usage, actions, groups, prefix)

    def add_text(self, text: str | None) -> None:
        """A description, or an example after it, whose lines are indented."""
        super().add_text(text and "\n".join(map(_broken, text.splitlines())))


def _usage(prog: str, actions: Iterable[argparse.Action]) -> str:
    """A usage in lines that fit, the same with every Python: argparse breaks its own elsewhere since 3.13."""
    whole = argparse.HelpFormatter(prog, width=10**6)
    whole.add_usage(None, actions, [])
    head, words = f"usage: {prog} ", whole.format_help().strip()
    rest = textwrap.wrap(
        words.removeprefix(head).replace(" ...", "\0..."),
        _columns() - len(head),
        break_long_words=False,
        break_on_hyphens=False,
    )
    indented = f"\n{' ' * len(head)}".join(rest).replace("\0", " ")
    return f"{prog} {indented}".replace("%", "%%")


def _broken(line: str) -> str:
    """A line of a description, or an indented line of a command, in lines that fit."""
    if not line.startswith(" "):
        return textwrap.fill(line, _columns())
    return " \\\n".join(
        textwrap.wrap(line, _columns() - 2, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    )


_NEGATIVE = re.compile(r"-\.?\d")
"""How a negative number, or a list of numbers whose first is negative, begins; no option begins so."""


class Parser(argparse.ArgumentParser):
    """A parser of one command, or of all; sections: title → command → description, for the help of all."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **{"formatter_class": _Help, "allow_abbrev": False, **named})
        self.sections: dict[str, dict[str, str]] = {}
        self._commands: Mapping[str, Parser] = {}
        self._negative_number_matcher = _NEGATIVE

    def add_commands(self) -> _SubParsersAction[Parser]:
        """Begin the commands of this parser; each is then added to what this returns."""
        added = self.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=Parser)
        self._commands = added.choices
        return added

    def add_argument(self, *given: Any, **named: Any) -> argparse.Action:
        """Add an argument as argparse does. A word that is not among its choices gets a hint."""
        if "choices" in named and "type" not in named:
            named["type"] = _choice(named["choices"])
        return super().add_argument(*given, **named)

    def options(self) -> set[str]:
        """The options of this parser and of all its commands, as a user types them."""
        return set(self._own_options()).union(*(command.options() for command in self._commands.values()))

    def _own_options(self) -> list[str]:
        return [*getattr(self, "_option_string_actions", ())]

    def format_help(self) -> str:
        """For a parser with sections, the commands under their titles; otherwise as argparse writes it."""
        if not self.sections:
            return super().format_help()
        width = 2 + max(len(name) for commands in self.sections.values() for name in commands)
        about = textwrap.wrap(str(self.description), _columns())
        parts = [f"usage: {self.prog} [options] COMMAND ...", "", *about, ""]
        for title, commands in self.sections.items():
            parts.append(f"{title}:")
            parts += (f"  {line}" for line in name_lines(commands, width, _columns() - 2))
            parts.append("")
        parts += textwrap.wrap(str(self.epilog), _columns())
        return "\n".join(parts) + "\n"

    def parse_whole(self, given: Sequence[str]) -> argparse.Namespace:
        """The options; exits with a hint if an argument is unknown."""
        self._check_commands(given)
        options, unknown = self.parse_known_args(given)
        if unknown:
            unknown = getattr(options, "parser", self)._take_rest(options, unknown)
        if unknown:
            parser: Parser = getattr(options, "parser", self)
            word = unknown[0]
            names = [name for name in parser._own_options() if name.startswith("--")]
            kind = "option" if word.startswith("-") else "argument"
            parser.error(f"unknown {kind} {word}{near(word.partition('=')[0], names)}")
        return options

    def _take_rest(self, options: argparse.Namespace, unknown: list[str]) -> list[str]:
        """Add words after an option to the last argument, if it takes any number: argparse took it for complete. The others."""
        arguments = [action for action in self._actions if not action.option_strings]
        if not arguments or arguments[-1].nargs != argparse.ZERO_OR_MORE or unknown[0].startswith("-"):
            return unknown
        words = [*takewhile(lambda word: not word.startswith("-"), unknown)]
        setattr(options, arguments[-1].dest, [*getattr(options, arguments[-1].dest), *words])
        return unknown[len(words) :]

    def _check_commands(self, given: Sequence[str]) -> None:
        """Exit with a hint if a word that must be a command is not one. After an option, argparse finds out by itself."""
        parser = self
        for word in given:
            if not parser._commands or word.startswith("-"):
                return
            if word not in parser._commands:
                parser.error(f"unknown command {word}{near(word, parser._commands)}")
            parser = parser._commands[word]

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where to read more, and exit with status 2."""
        self.exit(2, f"{self.prog}: {message}\ntry: {self.prog} --help\n")


def _choice(names: Iterable[str]) -> Callable[[str], str]:
    """The type of an argument that must be one of these names."""

    def checked(word: str) -> str:
        if word in names:
            return word
        raise argparse.ArgumentTypeError(f"is {word!r}; expected one of {', '.join(names)}{near(word, names)}")

    return checked
