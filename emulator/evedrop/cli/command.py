"""The class of commands of the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

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
