"""What a command is, and what its options are made of."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

Option = Callable[[argparse.ArgumentParser], None]
"""A function that adds an option, or several, to a command's parser."""


@dataclass(frozen=True)
class Command:
    """A command: its name, the function that carries it out, its description, and its options."""

    name: str
    run: Callable[[argparse.Namespace], int]
    """Takes the options, and returns the exit status. Slow imports belong inside: all commands are loaded for `--help`."""
    does: str
    """In a few words, for `--help`."""
    options: tuple[Option, ...] = ()
    group: str | None = None
    """The word before its name, such as `links` in `links fit`; None if it has no such word."""
    section: str = "other commands"
    """The title under which `--help` lists it."""
    example: str = ""
    """A command line that shows its use, without the program's name."""
    page: str = ""
    """The page of the documentation about it, such as `links`, as `evedrop docs` knows it."""


def command(
    options: tuple[Option, ...] = (), name: str = "", **more: str
) -> Callable[[Callable[[argparse.Namespace], int]], Command]:
    """Make a command of a function, with its name unless another is given; its docstring says what the command does.

    more: other entries of `Command`.
    """

    def made(run: Callable[[argparse.Namespace], int]) -> Command:
        sentence = (run.__doc__ or run.__name__).partition("\n")[0]  # `python -OO` removes docstrings
        does = f"{sentence[0].lower()}{sentence[1:].removesuffix('.')}"
        return Command(name or run.__name__, run, does, options, **more)

    return made


def option(name: str, shown: str | None = None, help_text: str | None = None, **how: Any) -> Option:
    """An option, or a positional argument; shown: what the help calls its value; how: as for `ArgumentParser.add_argument`."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(name, metavar=shown, help=help_text, **how)

    return add


def flag(name: str, help_text: str) -> Option:
    """An option without a value."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(name, action="store_true", help=help_text)

    return add


def together(*options: Option) -> Option:
    """Several options as one."""

    def add(parser: argparse.ArgumentParser) -> None:
        for each in options:
            each(parser)

    return add


def one_of(*options: Option, required: bool = False) -> Option:
    """Options of which at most one can be given; required: one must be."""

    def add(parser: argparse.ArgumentParser) -> None:
        group = parser.add_mutually_exclusive_group(required=required)
        together(*options)(cast("argparse.ArgumentParser", group))

    return add


def number_type(least: float, most: float, words: str) -> Callable[[str], float]:
    """The type of an option that is a number from `least` to `most`; words: what it must be, for the message."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text} is not {words}")
        return value

    return number
