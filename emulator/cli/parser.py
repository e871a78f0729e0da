"""The parser of the command line: argparse, with a hint for a mistyped word, no abbreviations, and help in sections."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from evedrop.hints import near

_WIDEST = 100
_NARROWEST = 30


def _columns() -> int:
    """The width of help: that of the terminal, within limits. Unlike argparse's own, at least 30."""
    return max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size().columns - 2))


class _Help(argparse.RawDescriptionHelpFormatter):
    """Keeps within the width, and breaks an example as a shell reads it."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=_columns())

    def add_usage(
        self,
        usage: str | None,
        actions: Iterable[argparse.Action],
        groups: Iterable[Any],
        prefix: str | None = None,
    ) -> None:
        """Without the options that may be left out, which are listed below it."""
        if prefix is None:
            options = argparse.Action([], "options", metavar="[options]")
            actions = [options, *(one for one in actions if one.required or not one.option_strings)]
        super().add_usage(usage, actions, groups if prefix is not None else [], prefix)

    def add_text(self, text: str | None) -> None:
        """A description, or an example after it, whose lines are indented."""
        super().add_text(text and "\n".join(map(_broken, text.splitlines())))


def _broken(line: str) -> str:
    """A line of a description, or an indented line of a command, in lines that fit."""
    if not line.startswith(" "):
        return textwrap.fill(line, _columns())
    return " \\\n".join(
        textwrap.wrap(line, _columns() - 2, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    )


class Parser(argparse.ArgumentParser):
    """A parser of one command, or of all; sections: title → command → description, for the help of all."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **{"formatter_class": _Help, "allow_abbrev": False, **named})
        self.sections: dict[str, dict[str, str]] = {}

    def format_help(self) -> str:
        """For a parser with sections, the commands under their titles; otherwise as argparse writes it."""
        if not self.sections:
            return super().format_help()
        width = 2 + max(len(name) for commands in self.sections.values() for name in commands)
        about = textwrap.wrap(str(self.description), _columns())
        parts = [f"usage: {self.prog} [options] COMMAND ...", "", *about, ""]
        for title, commands in self.sections.items():
            parts.append(f"{title}:")
            for name, does in commands.items():
                lines = textwrap.wrap(does, max(20, _columns() - width - 2)) or [""]
                parts.append(f"  {name:<{width}}{lines[0]}")
                parts += [" " * (width + 2) + line for line in lines[1:]]
            parts.append("")
        parts += textwrap.wrap(str(self.epilog), _columns())
        return "\n".join(parts) + "\n"

    def parse_whole(self, given: Sequence[str]) -> argparse.Namespace:
        """The options; exits with a hint if an argument is unknown."""
        options, unknown = self.parse_known_args(given)
        if unknown:
            parser: Parser = getattr(options, "parser", self)
            word = unknown[0]
            known = [name for name in parser._option_string_actions if name.startswith("--")]
            what = "option" if word.startswith("-") else "argument"
            parser.error(f"unknown {what} {word}{near(word.partition('=')[0], known)}")
        return options

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Name the nearest choice, and of commands no other."""
        if action.choices is None or value in action.choices:
            return
        names = [str(one) for one in action.choices]
        hint = near(value, names)
        if isinstance(action, argparse._SubParsersAction):
            raise argparse.ArgumentError(None, f"unknown command {value}{hint}")
        raise argparse.ArgumentError(action, f"is {value!r}; expected one of {', '.join(names)}{hint}")

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where to read more, and exit with status 2."""
        self.exit(2, f"{self.prog}: {message}\ntry: {self.prog} --help\n")
