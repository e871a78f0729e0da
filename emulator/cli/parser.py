"""The parser of the command line: argparse, with a hint for a mistyped word, no abbreviations, and help in sections."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

_WIDEST = 100
_NARROWEST = 30


def _hint(word: str, names: Iterable[str]) -> str:
    import difflib

    close = difflib.get_close_matches(word, list(names), 1)
    return f"; did you mean {close[0]}?" if close else ""


def _columns() -> int:
    """The width of help: that of the terminal, within limits. Unlike argparse's own, at least 30."""
    return max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size().columns - 2))


class _Help(argparse.RawDescriptionHelpFormatter):
    """Leaves the lines of an example as they are."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=_columns())


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
            parser.error(f"unknown {what} {word}{_hint(word.partition('=')[0], known)}")
        return options

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Name the nearest choice instead of listing all of them."""
        if action.choices is not None and value not in action.choices:
            names = [str(one) for one in action.choices]
            what = (
                "unknown command" if isinstance(action, argparse._SubParsersAction) else f"{value!r} is not a choice:"
            )
            said = f"{what} {value}" if what.startswith("unknown") else f"{what} expected one of {', '.join(names)}"
            raise argparse.ArgumentError(
                None if what.startswith("unknown") else action, f"{said}{_hint(str(value), names)}"
            )

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where to read more, and exit with status 2."""
        self.exit(2, f"{self.prog}: {message}\ntry: {self.prog} --help\n")
